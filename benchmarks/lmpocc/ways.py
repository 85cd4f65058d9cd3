"""Ways to predict: which weights, and what they read and write."""

from dataclasses import dataclass

from openvocab_occ.networks.fusion import FusionKind
from openvocab_occ.training.streams import MemoryConfig

_TRAINING = MemoryConfig()
LONG_TERM = MemoryConfig(prior_from="other_logs", misplaced=0.0)


@dataclass(frozen=True, kw_only=True)
class Weights:
    """What is trained around the frozen baseline."""

    name: str
    fusion: FusionKind = "cp"
    head_only: bool = False
    memory: MemoryConfig = _TRAINING


@dataclass(frozen=True, kw_only=True)
class Way:
    """An evaluation of some weights."""

    name: str
    weights: str
    memory: MemoryConfig = LONG_TERM
    blind: bool = False
    """Read for the regions' sake, but predict with an empty prior."""
    writer: str = ""
    """`base`: the baseline's own head writes the map; `truth`: the labels do, the most that any writer could give. A
    network's name: that baseline writes it."""
    gate: bool = False
    """A learned gate writes the map."""


HEAD = Weights(name="head", head_only=True)
LMOP = Weights(name="lmop")


def _reads(**options: object) -> MemoryConfig:
    return MemoryConfig(**{"prior_from": "other_logs", "misplaced": 0.0, **options})  # pyright: ignore[reportArgumentType]


def trained(tables: tuple[str, ...]) -> list[Weights]:
    """Return what must be trained for some tables."""
    found = [HEAD, LMOP]
    if "III" in tables:
        kinds: tuple[FusionKind, ...] = ("concat", "add", "concat_branch", "add_branch", "nmp")
        found += [Weights(name=f"fusion-{kind}", fusion=kind) for kind in kinds]
    if "V" in tables:
        found += [Weights(name="no-mask", memory=MemoryConfig(mask_from="none")),
                  Weights(name="truth-mask", memory=MemoryConfig(mask_from="truth"))]  # fmt: skip
    if "VI" in tables:
        found += [Weights(name=f"removal-{v}", memory=MemoryConfig(dynamic=v)) for v in ("v1", "v2")]
    return found


def ways(tables: tuple[str, ...], other_network: str = "") -> list[Way]:
    """Return what is evaluated for some tables; the first ones are Table II and its controls."""
    found = [
        Way(name="head", weights="head", blind=True),
        Way(name="empty", weights="lmop", blind=True),
        Way(name="other_logs", weights="lmop"),
        Way(name="all", weights="lmop", memory=_reads(prior_from="all")),
        Way(name="elsewhere", weights="lmop", memory=_reads(misplaced=1.0)),
    ]
    if "gate" in tables:
        found += [Way(name="write-gate", weights="lmop", memory=_reads(policy="gate"), gate=True)]
    if "source" in tables:
        found += [Way(name=s, weights="lmop", memory=_reads(prior_from=s)) for s in ("own_log", "other_scenes")]
    if "policies" in tables:
        found += [
            Way(name=f"policy-{p}", weights="lmop", memory=_reads(policy=p)) for p in ("overwrite", "ema", "bayes")
        ]
        found += [Way(name=f"removed-{v}", weights="lmop", memory=_reads(dynamic=v)) for v in ("v1", "v2")]
        found += [Way(name=f"mask-{m}", weights="lmop", memory=_reads(mask_from=m)) for m in ("truth", "none")]
    if "noise" in tables:
        found += [Way(name=f"noise-{m:g}m", weights="lmop", memory=_reads(noise=(m, 2 * m))) for m in (0.2, 0.5, 1.0)]
    if "III" in tables:
        found += [Way(name=w.name, weights=w.name) for w in trained(("III",)) if w.name.startswith("fusion-")]
    if "V" in tables:
        found += [Way(name="trained-no-mask", weights="no-mask", memory=_reads(mask_from="none")),
                  Way(name="trained-truth-mask", weights="truth-mask", memory=_reads(mask_from="truth"))]  # fmt: skip
    if "VI" in tables:
        found += [
            Way(name=f"trained-removal-{v}", weights=f"removal-{v}", memory=_reads(dynamic=v)) for v in ("v1", "v2")
        ]
    if "cross" in tables:
        found += [Way(name=f"written-by-{w}", weights="lmop", writer=w) for w in ("base", "truth")]
        found += (
            [Way(name=f"written-by-{other_network}", weights="lmop", writer=other_network)] if other_network else []
        )
    return found
