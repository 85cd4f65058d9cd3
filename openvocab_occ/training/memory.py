"""Train and judge a memory around a frozen baseline (LMPOcc III-B to III-D), as a toy of it taught.

The baseline is frozen and its latent features are cached. Cities are parallel streams: a batch holds different cities,
so that nothing in it depends on each other; the order of a city's drives is drawn anew for each epoch, which begins
with empty maps. Some frames read nothing and some read elsewhere, so that an empty map costs nothing and a
wrong one little.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from openvocab_occ.errors import ConfigError, DataError
from openvocab_occ.evaluation.occupancy import OccupancyScore, RayScore
from openvocab_occ.io.files import PathLike
from openvocab_occ.networks.lmop import Lmop
from openvocab_occ.networks.predictor import OccupancyNetwork
from openvocab_occ.occupancy import OccupancyGrid
from openvocab_occ.training.drives import Drive
from openvocab_occ.training.latents import Latents
from openvocab_occ.training.loop import Run, TrainConfig, class_weights, loss_of, rate_at, told_of_memory
from openvocab_occ.training.stream_map import Gate
from openvocab_occ.training.streams import (
    MemoryConfig,
    PriorSource,
    Visit,
    batches,
    check_memory,
    hidden,
    make_streams,
    read_prior,
    without_dynamic,
    written_mask,
)

Advance = Callable[[int, int], None]
Places = Mapping[str, Sequence[Drive]]
Writer = Callable[[Sequence[Visit]], np.ndarray]


def train_memory(
    network: OccupancyNetwork,
    places: Places,
    latents: Latents,
    folder: PathLike,
    config: TrainConfig | None = None,
    *,
    memory: MemoryConfig | None = None,
    head_only: bool = False,
    progress: Advance | None = None,
) -> Path:
    """Train alignment, fusion and head; return the file of the weights.

    With `head_only` the prior stays empty, so that the head alone learns, from the same frames for as many steps: the
    control that tells memory from more training. Checkpoints are taken between epochs, where the maps are empty.
    """
    config, memory = config or TrainConfig(flip=False), memory or MemoryConfig()
    module = network.module
    if not isinstance(module, Lmop):
        raise ConfigError("the network has no memory", fix="load_network(..., memory=True)")
    if config.flip:
        raise ConfigError("the ground cannot be mirrored with memory on", fix="flip=False, as the paper does")
    drives = [drive for found in places.values() for drive in found]
    if not drives:
        raise DataError("there is nothing to train on", expected="drives with frames")
    check_memory(network, drives)
    if head_only:
        memory = replace(memory, prior_from="none")
    device = next(module.parameters()).device
    weights = class_weights(drives, network.config.classes).to(device)
    module.train()
    learned = [p for p in module.parameters() if p.requires_grad]
    for parameter in module.align.parameters(), module.fusion.parameters():
        for p in parameter:
            p.requires_grad_(not head_only)
    optimiser = torch.optim.AdamW(learned, lr=config.rate, weight_decay=config.decay)
    settings = {"network": network.name, **asdict(config), **_plain(memory), "head_only": head_only}
    run = Run(Path(folder), module, optimiser, settings)
    epoch = 0
    while run.step < config.steps:
        first = run.step
        rng = np.random.default_rng([config.seed, first])
        streams = make_streams(places, network.config, rng)
        sources: dict[str, PriorSource] = {}
        for batch in batches(streams, config.batch, rng):
            with told_of_memory(network.name, device), torch.autocast(device.type, torch.bfloat16, enabled=config.amp):
                current = latents.of([(v.drive, v.frame) for v in batch]).to(device)
                if head_only:
                    logits = module.occ_head(current).float()
                else:
                    prior, known = _priors(batch, memory, sources, rng, training=True)
                    logits = module.refine(current, prior.to(device), known.to(device)).float()
                labels = torch.from_numpy(np.stack([v.drive.labels[v.frame] for v in batch])).to(device)
                mask = torch.from_numpy(np.stack([v.drive.mask[v.frame] for v in batch])).to(device)
                run.learn(loss_of(logits, labels, mask, config.loss, weights), rate_at(run.step, config), config.clip,
                          config.ema)  # fmt: skip
            if not head_only:
                write_back(batch, logits.detach().cpu().numpy(), network, memory)
            if progress is not None:
                progress(run.step, config.steps)
            if run.step >= config.steps:
                break
        epoch += 1
        run.save()
    return run.finish()


@dataclass
class MemoryScore:
    """Confusions by place, visit and condition: of what cameras see, with and without prior, the hidden, the map.

    `map` compares the likeliest classes of the prior itself with the truth of that moment, where the map knows
    something that is not inside a thing.
    """

    parts: dict[tuple[str, int, str], dict[str, OccupancyScore]] = field(default_factory=dict)

    def add(self, visit: Visit, predicted: np.ndarray, known: np.ndarray, remembered: np.ndarray | None = None) -> None:
        """Count a frame; `remembered` are the labels of the map."""
        info = visit.drive.info
        order = visit.stream.drives.index(visit.drive)
        scores = self.parts.setdefault((info.place, order, info.condition), {k: OccupancyScore() for k in REGIONS})
        truth, mask = visit.drive.labels[visit.frame], visit.drive.mask[visit.frame]
        unseen = hidden(truth, mask)
        regions = {"seen": mask, "covered": mask & known, "uncovered": mask & ~known, "hidden": unseen,
                   "hidden_covered": unseen & known}  # fmt: skip
        for name, region in regions.items():
            scores[name].add(predicted, truth, region)
        if remembered is not None:
            scores["map"].add(remembered, truth, (mask | unseen) & known)

    def total(self, region: str, condition: str | None = None) -> OccupancyScore:
        """Add up all places and visits, or those of a condition."""
        found = OccupancyScore()
        for (_, _, name), scores in self.parts.items():
            if condition in (None, name):
                found.confusion += scores[region].confusion
        return found

    def summary(self) -> dict[str, object]:
        """Return the rows of a report, percent."""
        conditions = sorted({condition for _, _, condition in self.parts if condition})
        return {
            "seen": self.total("seen").to_dict(), "with_prior": self.total("covered").to_dict(),
            "without_prior": self.total("uncovered").to_dict(), "map": self.total("map").to_dict(),
            "by_condition": {name: self.total("seen", name).to_dict() for name in conditions},
        }  # fmt: skip

    def to_dict(self) -> list[dict[str, object]]:
        """Return plain rows; confusions as lists of counts."""
        return [
            {"place": place, "visit": visit, "condition": condition,
             **{name: score.confusion.ravel().tolist() for name, score in scores.items()}}
            for (place, visit, condition), scores in self.parts.items()
        ]  # fmt: skip


REGIONS = ("seen", "covered", "uncovered", "hidden", "hidden_covered", "map")


class RayCounter:
    """Counts RayIoU of what is predicted, from the LiDAR's place in each frame."""

    def __init__(self, network: OccupancyNetwork) -> None:
        self.spec = network.spec
        self.score = RayScore()

    def __call__(self, visit: Visit, logits: np.ndarray) -> None:
        """Count a frame."""
        labels = logits.argmax(axis=-1).astype(np.uint8)
        truth = OccupancyGrid(visit.drive.labels[visit.frame], self.spec)
        self.score.add(OccupancyGrid(labels, self.spec), truth, visit.drive.origins[visit.frame][None])


@torch.no_grad()
def evaluate_memory(
    network: OccupancyNetwork,
    places: Places,
    latents: Latents,
    memory: MemoryConfig,
    *,
    batch: int = 8,
    seed: int = 0,
    writer: Writer | None = None,
    blind: bool = False,
    gate: Gate | None = None,
    observer: Callable[[Visit, np.ndarray], None] | None = None,
    progress: Advance | None = None,
) -> MemoryScore:
    """Drive through places in the order of their visits with maps that begin empty, and count what is predicted.

    Args:
        network: With memory, or a baseline, which then reads nothing.
        places: Drives by place.
        latents: Of the baseline.
        memory: Source of priors and policies; with `none` nothing is written either.
        batch: Places at a time.
        seed: Of pose noise.
        writer: Gives the logits that are written in place of the network's own: a prior of another model.
        blind: Give the network an empty prior all the same: a control that is judged in the same regions.
        gate: With the policy `gate`: chooses how much of old and new is stored.
        observer: Told of the logits of each frame.
        progress: Told of frames.
    """
    module = network.module.eval()
    rng = np.random.default_rng(seed)
    score, done = MemoryScore(), 0
    total = sum(len(drive) for drives in places.values() for drive in drives)
    device = next(module.parameters()).device
    memory = replace(memory, misplaced=float(memory.misplaced == 1.0))
    for visits in batches(make_streams(places, network.config), batch):
        current = latents.of([(v.drive, v.frame) for v in visits]).to(device)
        known, remembered = np.zeros((len(visits), *network.config.shape), np.bool_), None
        with torch.autocast(device.type, torch.bfloat16):
            if isinstance(module, Lmop):
                prior, seen = _priors(visits, memory, {}, rng, training=False)
                known = seen.numpy()
                remembered = None if memory.misplaced else prior.numpy().argmax(axis=-1).astype(np.uint8)
                if blind:
                    prior, seen = torch.zeros_like(prior), torch.zeros_like(seen)
                logits = module.refine(current, prior.to(device), seen.to(device))
            else:
                logits = module.occ_head(current)
        found = logits.float().cpu().numpy()
        labels = found.argmax(axis=-1).astype(np.uint8)
        for b, v in enumerate(visits):
            score.add(v, labels[b], known[b], None if remembered is None else remembered[b])
            if observer is not None:
                observer(v, found[b])
        if isinstance(module, Lmop) and memory.prior_from != "none":
            told = found if writer is None else writer(visits)
            write_back(visits, told, network, memory, gate=gate, own=memory.prior_from == "own_log")
        done += len(visits)
        if progress is not None:
            progress(done, total)
    return score


def write_back(
    visits: Sequence[Visit], logits: np.ndarray, network: OccupancyNetwork, memory: MemoryConfig, *,
    gate: Gate | None = None, own: bool = False,
) -> None:  # fmt: skip
    """Write predictions into the streams' maps, what is seen of them; read before write is the caller's order."""
    labels = logits.argmax(axis=-1).astype(np.uint8)
    for b, visit in enumerate(visits):
        mask = written_mask(visit, labels[b], network.config, memory.mask_from)
        kept = without_dynamic(logits[b], mask, memory.dynamic, seed=visit.frame)
        stamp = float(visit.drive.stamps[visit.frame])
        visit.stream.write(visit.T_world_ego, kept, mask, memory.policy, gate=gate, stamp=stamp, own=own)


def _priors(
    visits: Sequence[Visit], memory: MemoryConfig, sources: dict[str, PriorSource], rng: np.random.Generator,
    *, training: bool,
) -> tuple[Float[Tensor, "b x y z classes"], Tensor]:  # fmt: skip
    found = []
    for visit in visits:
        if memory.prior_from == "mixed":
            name = visit.drive.info.name
            source = sources.setdefault(name, "all" if rng.random() < 0.5 else "other_logs")
        else:
            source = memory.prior_from
        found.append(read_prior(visit, source, memory, rng, training=training))
    logits = torch.from_numpy(np.stack([prior.logits for prior in found]))
    return logits, torch.from_numpy(np.stack([prior.known for prior in found]))


def _plain(memory: MemoryConfig) -> dict[str, object]:
    return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(memory).items()}
