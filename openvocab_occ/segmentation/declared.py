"""What a model file declares against what its card says, before anything runs."""

import numpy as np

from openvocab_occ.errors import ModelError
from openvocab_occ.io.files import sha256
from openvocab_occ.segmentation.card import Card
from openvocab_occ.segmentation.outputs import Reader
from openvocab_occ.segmentation.session import Port, Session


def check_declared(card: Card, session: Session, reader: Reader) -> None:
    """Raise ModelError where input, output or hash of the file cannot be what the card describes."""
    if card.sha256 is not None and card.sha256 != (found := sha256(session.path)):
        raise ModelError(
            f"the card {card.name!r} is for another file than {session.path.name}",
            expected=f"sha256 {card.sha256[:16]}...",
            got=f"{found[:16]}...",
        )
    if len(session.inputs) != 1:
        raise reader.misfit(
            "one input, an image",
            "; ".join(map(str, session.inputs)),
            "a model with words among its inputs: fix the list of words, export it so, and use contract logits",
        )
    _check_input(card, session.input(card.input.name), reader)
    _check_output(card, session.output(card.output.name), reader)
    for name in filter(None, (card.output.embeddings, card.output.scores, card.output.void)):
        session.output(name)


def _check_input(card: Card, port: Port, reader: Reader) -> None:
    if port.numpy not in (np.float32, np.float16, np.uint8) or len(port.shape) != 4:
        raise reader.misfit("images of 4 axes, float or uint8", str(port))
    batch, *rest = port.shape
    height, width, channels = rest if card.input.layout == "NHWC" else (*rest[1:], rest[0])
    swapped = channels is None and rest[0 if card.input.layout == "NHWC" else 2] == 3
    if channels not in (None, 3) or swapped:
        raise reader.misfit(f"3 colours in layout {card.input.layout}", str(port), "check input.layout")
    if batch not in (None, 1):
        raise reader.misfit("a batch of 1 or of any size", str(port), "export it so")
    wanted = card.input.size or (card.input.tile.size if card.input.tile is not None else (None, None))
    for name, has, asked in (("height", height, wanted[0]), ("width", width, wanted[1])):
        if has is not None and has != asked:
            raise reader.misfit(f"{name} {asked or 'free'} as in the card", str(port), "write input.size")


def _check_output(card: Card, port: Port, reader: Reader) -> None:
    layout = card.output.layout
    if card.output.kind == "classes" or not port.shape:
        return
    axes = {"NTC": 3, "NC": 2}.get(layout, 4)
    if len(port.shape) != axes:
        raise reader.misfit(f"an output of {axes} axes in layout {layout}", str(port))
    if card.output.kind == "masks":
        return
    channels = port.shape[1 if layout == "NCHW" else axes - 1]
    if channels not in (None, reader.dim):
        raise reader.misfit(
            f"{reader.dim} channels in layout {layout}, {reader.channel_source()}",
            f"{channels} in {port}",
            "check output.layout and labels"
            if not reader.from_text
            else "check output.layout: such features are not aligned",
        )
