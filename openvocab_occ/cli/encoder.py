"""The encoder a command asks a map with."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from openvocab_occ.segmentation.encoder import PixelEncoder


def encoder_for(map: Path, encoder: Path | None, card: Path | None) -> "PixelEncoder | None":
    """Return the named encoder, else the shipped one where it made the map or a map of the folder, else none."""
    from openvocab_occ.objects.ovmap import MANIFEST, read_manifest
    from openvocab_occ.segmentation.demo_models import demo_model
    from openvocab_occ.segmentation.onnx import load_encoder

    if encoder is not None:
        return load_encoder(encoder, card)
    folders = [file.parent for file in (map / MANIFEST, *sorted(map.glob(f"*.ovmap/{MANIFEST}"))) if file.is_file()]
    made_by = [read_manifest(folder)["encoder"] for folder in folders]
    prints = {made["fingerprint"] for made in made_by if made["contract"] != "logits"}
    if not prints:
        return None
    shipped = load_encoder(demo_model())
    return shipped if shipped.fingerprint in prints else None
