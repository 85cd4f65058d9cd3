"""Probabilities from labelled voxels: Platt scaling of a dense map's cosines, stored in the model's card."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from msgspec import structs

from openvocab_occ.errors import ConfigError, DataError, EncoderMismatchError
from openvocab_occ.io.files import PathLike, existing
from openvocab_occ.mapping.keys import keys_of
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.segmentation.card import Calibration
from openvocab_occ.segmentation.card_files import read_card, write_card
from openvocab_occ.segmentation.onnx import load_encoder
from openvocab_occ.segmentation.scoring import fit_platt


def calibrate_card(scene: SceneMap, labels: PathLike, model: Path, card: Path, *, dataset: str) -> Calibration:
    """Fit on every (voxel, word) pair of the labels and rewrite the card with the result.

    `labels` is a .npz with `points` (n, 3), metres in the world, and `names` (n), the word that is true of each. Each
    labelled voxel is asked for every word among the names; the pair is positive where the word is its own.
    """
    if scene.encoder.contract != "dense":
        raise ConfigError("only cosines are calibrated", expected="a map of a dense model", got=scene.encoder.contract)
    encoder = load_encoder(model, card)
    if encoder.fingerprint != scene.encoder.fingerprint or encoder.text is None:
        raise EncoderMismatchError(
            "the encoder is not the one that made this map", expected=scene.encoder.name, got=encoder.name
        )
    points, names = _read_labels(labels)
    row = scene.voxels.index(keys_of(points, scene.voxels.voxel_size))
    there = row >= 0
    if not there.any():
        raise DataError("no label lies in a voxel of the map", expected="world coordinates in metres", got=len(row))
    words, own = np.unique(names[there], return_inverse=True)
    vectors = encoder.text.encode([str(word) for word in words])
    cosines = scene.voxels.features[row[there]] @ vectors.T  # n words
    positive = own[:, None] == np.arange(len(words))
    date = datetime.now(UTC).date().isoformat()
    fitted = fit_platt(cosines.ravel().astype(np.float64), positive.ravel(), dataset=dataset, date=date)
    old = read_card(card)
    write_card(structs.replace(old, score=structs.replace(old.score, calibration=fitted, threshold=None)), card)
    return fitted


def _read_labels(file: PathLike) -> tuple[np.ndarray, np.ndarray]:
    path = existing(file, "labels")
    try:
        with np.load(path, allow_pickle=False) as content:
            points, names = content["points"], content["names"]
    except (ValueError, OSError, KeyError, EOFError, AttributeError) as error:
        raise DataError(
            f"labels {path.name} cannot be read", expected="points and names in a .npz", got=error
        ) from error
    if points.ndim != 2 or points.shape[1] != 3 or names.shape != (len(points),) or names.dtype.kind != "U":
        raise DataError(
            f"labels {path.name} are not usable",
            expected="points (n, 3) and names (n) as text",
            got=f"points {points.shape}, names {names.dtype} {names.shape}",
        )
    return points.astype(np.float64), names
