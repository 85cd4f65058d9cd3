"""Learn what to write and how fast to forget, through several traversals of a place.

What a frozen memory predicted along drives is recorded once. A step then takes a frame, some frames of earlier
traversals that saw the same ground, and writes them through the gate in order of time; every write is differentiable.
The loss asks two things of the map that results: that it is right where the frame's truth can tell, and that the frame,
reading it, predicts rightly.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from openvocab_occ.errors import ConfigError, DataError
from openvocab_occ.geometry import GridSpec
from openvocab_occ.io.files import PathLike
from openvocab_occ.networks.lmop import Lmop, limited
from openvocab_occ.networks.losses import masked_cross_entropy
from openvocab_occ.networks.predictor import OccupancyNetwork
from openvocab_occ.networks.write_gate import WriteGate
from openvocab_occ.training.drives import Drive
from openvocab_occ.training.latents import Latents
from openvocab_occ.training.loop import Run, TrainConfig, class_weights, rate_at
from openvocab_occ.training.memory import evaluate_memory
from openvocab_occ.training.stream_map import BAYES_REACH, DAY
from openvocab_occ.training.streams import MemoryConfig, Visit, hidden, written_mask

Advance = Callable[[int, int], None]
Places = Mapping[str, Sequence[Drive]]
_REACH = 60.0  # metres between frames that may see the same ground


@dataclass(frozen=True, eq=False)
class Written:
    """What a frame would write."""

    drive: Drive
    frame: int
    logits: Float[np.ndarray, "x y z classes"]
    """Centred, limited; float16."""
    mask: Bool[np.ndarray, "x y z"]


@dataclass(frozen=True, kw_only=True)
class GateConfig:
    """How a gate is trained."""

    steps: int = 120
    frames: int = 2
    """Whose reading is judged in a step."""
    writes: int = 10
    """Most writes before each; how many, and which, is drawn."""
    rate: float = 5e-2
    map_weight: float = 1.0
    """Of the map's own cross entropy, beside that of the prediction which reads it."""
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.steps, self.frames, self.writes) < 1 or self.rate <= 0 or self.map_weight < 0:
            raise ConfigError(
                "a gate cannot be trained so", expected="steps, frames, writes and rate above 0", got=self
            )


def record(
    network: OccupancyNetwork, places: Places, latents: Latents, memory: MemoryConfig
) -> dict[str, list[Written]]:
    """Drive through places once, by the paper's way to write, and keep what each frame predicts, in order of time.

    It is held in memory: 3 MB a frame on 0.8 m voxels.
    """
    found: dict[str, list[Written]] = {name: [] for name in places}

    def keep(visit: Visit, logits: np.ndarray) -> None:
        centred = limited(torch.from_numpy(logits)).numpy().astype(np.float16)
        mask = written_mask(visit, logits.argmax(axis=-1).astype(np.uint8), network.config, memory.mask_from)
        found[visit.stream.place].append(Written(visit.drive, visit.frame, centred, mask))

    evaluate_memory(network, places, latents, memory, observer=keep)
    return found


def train_write_gate(
    network: OccupancyNetwork,
    recorded: Mapping[str, Sequence[Written]],
    latents: Latents,
    folder: PathLike,
    config: GateConfig | None = None,
    *,
    progress: Advance | None = None,
) -> Path:
    """Train a gate for a frozen memory on what it recorded; return the file of the gate's weights.

    Stopped, the same call goes on.

    Raises:
        ConfigError: The network has no memory.
        DataError: No place was visited twice.
    """
    config = config or GateConfig()
    module = network.module
    if not isinstance(module, Lmop):
        raise ConfigError("the network has no memory", fix="load_network(..., memory=True)")
    choices = [(name, i) for name, seen in recorded.items() for i in range(len(seen)) if earlier(seen, i)]
    if not choices:
        raise DataError("no place was visited twice", expected="drives of several days through the same streets")
    torch.manual_seed(config.seed)
    gate = WriteGate(network.config.classes).train()
    module.eval().requires_grad_(False)
    drives = list({w.drive.info.name: w.drive for seen in recorded.values() for w in seen}.values())
    weights = class_weights(drives, network.config.classes)
    optimiser = torch.optim.AdamW(gate.parameters(), lr=config.rate, weight_decay=1e-3)
    run = Run(Path(folder), gate, optimiser, {"network": network.name, **asdict(config)})
    rates = TrainConfig(steps=config.steps, rate=config.rate, warm_up=10, flip=False)
    for step in range(run.step, config.steps):
        rng = np.random.default_rng([config.seed, step])
        losses: list[Tensor] = []
        for k in rng.choice(len(choices), config.frames, replace=len(choices) < config.frames):
            name, i = choices[k]
            losses.append(_loss(gate, module, recorded[name], i, latents, weights, config, rng))
        run.learn(torch.stack(losses).mean(), rate_at(step, rates), 5.0, 0.97)
        if run.step % 20 == 0 or run.step == config.steps:
            run.save()
        if progress is not None:
            progress(run.step, config.steps)
    return run.finish()


def earlier(seen: Sequence[Written], index: int) -> list[int]:
    """Return which frames of other drives, earlier in time, were near enough to see what a frame sees."""
    here = seen[index]
    at, now = here.drive.poses[here.frame][:2, 3], here.drive.stamps[here.frame]
    near = [i for i, w in enumerate(seen) if np.linalg.norm(w.drive.poses[w.frame][:2, 3] - at) < _REACH]
    return [i for i in near if seen[i].drive.info.log != here.drive.info.log
            and seen[i].drive.stamps[seen[i].frame] < now]  # fmt: skip


def unroll(
    gate: nn.Module, writes: Sequence[Written], T_world_ego: Float[np.ndarray, "4 4"], spec: GridSpec
) -> tuple[Float[Tensor, "x y z classes"], Bool[np.ndarray, "x y z"]]:
    """Return what a map would hold in a window after writes, differentiable in the gate, and what is known.

    The map's lattice is left out: each voxel of the window takes what the writer's voxel at its centre says.
    """
    X, Y, Z = spec.shape
    classes = writes[0].logits.shape[-1]
    held = torch.zeros(X * Y * Z, classes)
    count, last = np.zeros(X * Y * Z, np.float32), np.zeros(X * Y * Z)
    for write in writes:
        columns, source, reach = _shared(T_world_ego, write.drive.poses[write.frame], spec)
        i, z = np.nonzero(write.mask.reshape(X * Y, Z)[source])
        if not len(i):
            continue
        place = columns[i] * Z + z
        new = torch.from_numpy(write.logits.reshape(X * Y, Z, classes)[source[i], z].astype(np.float32))
        stamp = float(write.drive.stamps[write.frame])
        age = np.where(count[place] > 0, np.maximum(stamp - last[place], 0) / DAY, 0)
        facts = torch.from_numpy(np.stack([count[place], age, reach[i]], axis=-1).astype(np.float32))
        where = torch.from_numpy(place)
        old = held[where]
        shares = gate(new, old, facts)
        stored = limited(shares[:, :1] * old + shares[:, 1:] * new, BAYES_REACH)
        held = held.index_put((where,), stored)
        count[place] += 1
        last[place] = stamp
    return held.reshape(X, Y, Z, classes), count.reshape(X, Y, Z) > 0


def _loss(
    gate: WriteGate, module: Lmop, seen: Sequence[Written], index: int, latents: Latents,
    weights: Float[Tensor, " classes"], config: GateConfig, rng: np.random.Generator,
) -> Float[Tensor, ""]:  # fmt: skip
    here = seen[index]
    drive, f = here.drive, here.frame
    candidates = earlier(seen, index)
    count = int(rng.integers(1, min(config.writes, len(candidates)) + 1))
    chosen = sorted(rng.choice(candidates, count, replace=False).tolist())
    spec = GridSpec(module.baseline.config.lower, module.baseline.config.cell, module.baseline.config.shape)
    held, known = unroll(gate, [seen[i] for i in chosen], drive.poses[f], spec)
    truth, mask = drive.labels[f], drive.mask[f]
    judged = known & (mask | hidden(truth, mask))
    labels, seen_now = torch.from_numpy(truth)[None].long(), torch.from_numpy(mask)[None]
    own = masked_cross_entropy(held[None], labels, torch.from_numpy(judged)[None], weights=weights)
    device = next(module.parameters()).device
    with torch.autocast(device.type, torch.bfloat16):
        current = latents.of([(drive, f)]).to(device)
        logits = module.refine(current, held[None].to(device), torch.from_numpy(known)[None].to(device)).float().cpu()
    return masked_cross_entropy(logits, labels, seen_now, weights=weights) + config.map_weight * own


def _shared(
    T_here: Float[np.ndarray, "4 4"], T_there: Float[np.ndarray, "4 4"], spec: GridSpec
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the columns of a window that another window covers, its columns there, and their distance from its ego."""
    X, Y, _ = spec.shape
    origin, cell = np.asarray(spec.origin)[:2], float(spec.size[0])
    ticks = [origin[k] + (np.arange(n) + 0.5) * cell for k, n in enumerate((X, Y))]
    centers = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 2)
    world = centers @ T_here[:2, :2].T + T_here[:2, 3]
    local = (world - T_there[:2, 3]) @ T_there[:2, :2]
    place = np.floor((local - origin) / cell).astype(np.int64)
    columns = np.flatnonzero(((place >= 0) & (place < (X, Y))).all(axis=-1))
    place = place[columns]
    middle = origin + (place + 0.5) * cell
    return columns, place @ np.array([Y, 1]), np.hypot(*middle.T)
