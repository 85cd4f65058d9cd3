"""Pictures of the synthetic city with the state of every fourth pixel, cached in files; one file a drive.

Pairs of colour and thing that the lexicon keeps out are painted over before a picture is taken, so that no training
picture holds them. Seeds of the city:

    training 1000-1063, validation 1100-1101; evaluation 2000-2003, never used here nor for any choice.

In some of the training cities many cars give way to what is rare in a street: buses, trailers, cones.

    python models/demo/scenes.py            # all training and validation drives; goes on where it stopped
"""

import sys
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import yaml
from phrases import SKY, State, kinds_of

from openvocab_occ.datasets.city import PART_NAMES, City, Traversal
from openvocab_occ.datasets.city import SKY as SKY_PART
from openvocab_occ.datasets.city.furniture import barrier, cone
from openvocab_occ.datasets.city.mesh import Mesh
from openvocab_occ.datasets.city.parking import vehicle
from openvocab_occ.datasets.city.riders import bicycle, pedestrian
from openvocab_occ.datasets.city.surfaces import PAINTS, Material
from openvocab_occ.datasets.city.things import Thing
from openvocab_occ.datasets.city.trucks import excavator, wheel_loader
from openvocab_occ.datasets.city.vehicles import CAR_KINDS

HERE = Path(__file__).parent
CACHE = HERE / "cache" / "drives"
TRAINING = tuple(range(1000, 1064))
ENRICHED = range(1035, 1064)
VALIDATION = (1100, 1101)
SIZE = (704, 256)
STRIDE = 4
KEYFRAMES = range(1, 40, 5)
_CONDITIONS = (
    "clear",
    "clear",
    "heavy traffic",
    "clear",
    "rain",
    "heavy traffic",
    "clear",
    "fog",
    "heavy traffic",
    "night",
)
_RARE = {
    "bus": 3, "van": 2, "trailer": 3, "motorcycle": 3, "bicycle": 3, "excavator": 1, "wheel loader": 1,
    "traffic cone": 1, "barrier": 1, "pedestrian": 2, "tanker truck": 1, "flatbed truck": 1,
}  # fmt: skip
_INSTEAD = ("white", "black", "silver", "brown", "beige", "grey")  # none of them is kept out


def repaint(drive: Traversal, lexicon: dict, seed: int) -> None:
    """Change the colour of every thing of a drive that must never be rendered, and put in what is rare."""
    banned = {(kind, color) for color, thing in lexicon["never_rendered"] for kind in kinds_of(lexicon, thing)}

    random, rare = np.random.default_rng(seed), seed in ENRICHED

    def other(thing: Thing) -> Thing:
        if rare and thing.kind in CAR_KINDS and random.random() < 0.5:
            return _rare(thing, random, banned)
        if (thing.kind, thing.color) not in banned:
            return thing
        color = _INSTEAD[thing.id % len(_INSTEAD)]
        return replace(thing, color=color, mesh=vehicle(thing.kind, color)[0])

    drive.still = [other(thing) for thing in drive.still]  # replaces what the drive would compute
    ego, movers = drive._motions
    drive._motions = (ego, [replace(mover, thing=other(mover.thing)) for mover in movers])


def _rare(thing: Thing, random: np.random.Generator, banned: set[tuple[str, str]]) -> Thing:
    """Put something that is rare in the place of a thing."""
    kind = str(random.choice(list(_RARE), p=np.array(list(_RARE.values())) / sum(_RARE.values())))
    color = str(random.choice([color for color in PAINTS if (kind, color) not in banned]))
    match kind:
        case "bicycle":
            mesh = bicycle(color)
        case "excavator" | "wheel loader":
            color = "yellow"
            mesh = excavator(color) if kind == "excavator" else wheel_loader(color)
        case "traffic cone" | "barrier":
            color = ""
            mesh = cone() if kind == "traffic cone" else barrier()
        case "pedestrian":
            mesh = pedestrian(color, int(random.integers(4)))
        case _:
            mesh = vehicle(kind, color)[0]
    return replace(thing, kind=kind, color=color, mesh=mesh)


def materials(mesh: Mesh) -> dict[int, str]:
    """Return the material that most of each part of a mesh is made of."""
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    table = np.zeros((256, len(Material)))
    np.add.at(table, (mesh.part, mesh.material), area)
    return {int(part): Material(int(table[part].argmax())).name.lower() for part in np.unique(mesh.part)}


class StateTable:
    """Numbers of states as they are met in a drive."""

    def __init__(self, drive: Traversal) -> None:
        self.states: list[State] = [SKY]
        self._number: dict[State, int] = {SKY: 0}
        self._things = {t.id: t for t in [*drive.still, *(m.thing for m in drive.movers)]}
        self._materials: dict[int, dict[int, str]] = {}

    def of(self, instance: np.ndarray, part: np.ndarray) -> np.ndarray:
        """Return the number of the state of each pixel, int16."""
        code = instance.astype(np.int64) * 256 + part
        used, where = np.unique(code, return_inverse=True)
        return np.array([self._one(int(c)) for c in used], dtype=np.int16)[where].reshape(code.shape)

    def _one(self, code: int) -> int:
        thing, part = self._things.get(code >> 8), code & 255
        if thing is None or part == SKY_PART:
            return 0
        made_of = self._materials.setdefault(id(thing.mesh), {}) or materials(thing.mesh)
        self._materials[id(thing.mesh)] = made_of
        state = State(thing.kind, thing.color, PART_NAMES[part], made_of.get(part, ""))
        if state not in self._number:
            self._number[state] = len(self.states)
            self.states.append(state)
        return self._number[state]


def write_drive(seed: int, lexicon: dict, folder: Path = CACHE) -> Path:
    """Render the keyframes of a drive through the town of a seed."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{seed}.npz"
    if path.exists():
        return path
    drive = City(seed).traversal(route=seed % 3, condition=_CONDITIONS[seed % len(_CONDITIONS)])
    repaint(drive, lexicon, seed)
    table = StateTable(drive)
    images, states = [], []
    for index in KEYFRAMES:
        for _, camera, time in drive.cameras(index, size=SIZE):
            seen = drive.render(camera, time)
            images.append(seen.image)
            at = np.s_[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
            states.append(table.of(seen.instance[at], seen.part[at]))
    scratch = path.with_suffix(".part.npz")
    np.savez(scratch, images=np.stack(images), states=np.stack(states), table=np.array(table.states, dtype="U32"))
    scratch.rename(path)
    return path


def main() -> None:
    """Render all drives, validation first."""
    lexicon = yaml.safe_load((HERE / "lexicon.yaml").read_text())
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as processes:
        drives = [processes.submit(write_drive, seed, lexicon) for seed in (*VALIDATION, *TRAINING)]
        for done, drive in enumerate(as_completed(drives), start=1):
            drive.result()
            print(f"\r{done} of {len(drives)} drives", end="", file=sys.stderr)


if __name__ == "__main__":
    main()
