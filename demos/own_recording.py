"""From your own arrays to answers: a folder of frames, your occupancy predictions, a map, questions.

    python demos/own_recording.py out/own

A synthetic street stands in for your vehicle and for your occupancy network; replace `drive` and `predict`.
"""

import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np

import openvocab_occ as ovo
from openvocab_occ.datasets import write_recording
from openvocab_occ.segmentation.demo_models import street_model


def drive() -> Iterable[ovo.Frame]:
    """Your frames: images with cameras in one world, and the pose of the vehicle."""
    return ovo.load_sequence("street", frames=4)


def predict(frame: ovo.Frame) -> np.ndarray:
    """Your occupancy network: labels [x, y, z] around the ego; of Occ3D's grid, no `occupancy_spec` is needed below."""
    assert frame.occupancy is not None
    return frame.occupancy.labels


def main(out: Path) -> None:
    """Write the folder and the predictions, then map and ask."""
    frames = list(drive())
    write_recording(out / "drive", frames)
    (out / "pred").mkdir(exist_ok=True)
    for frame in frames:
        np.savez_compressed(out / "pred" / f"{frame.token}.npz", semantics=predict(frame))

    spec = ovo.GridSpec(origin=(-20.0, -16.0, -1.0), voxel_size=0.4, shape=(100, 80, 16))
    sequence = ovo.load_sequence("recording", out / "drive", occupancy=f"{out}/pred/{{token}}.npz", occupancy_spec=spec)
    encoder = ovo.load_encoder(street_model())  # or your own ONNX: docs/models.md
    scene = ovo.build_map(sequence, encoder)
    scene.save(out / "street.ovmap")
    for text in ("parked trucks", "the largest building", "traffic cones"):
        print(ovo.find(scene, text, encoder).explain(), end="\n\n")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/own"))
