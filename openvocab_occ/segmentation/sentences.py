"""A card in words."""

from collections.abc import Iterator

from openvocab_occ.segmentation.card import Card, FilesCard

_CONTRACTS = {
    "dense": "features of each cell, aligned to words",
    "tokens": "one feature a patch token, aligned to words",
    "masks": "masks and one feature each",
    "crops": "one feature an image; made dense by windows or masks",
    "logits": "scores of a fixed list of labels",
    "files": "computed elsewhere, one file an image",
}


def sentences(card: Card | FilesCard) -> Iterator[tuple[str, str]]:
    """Yield topics and what the card says of them."""
    yield "name", card.name
    yield "gives", _CONTRACTS[card.contract]
    if isinstance(card, FilesCard):
        yield "files", f"{card.features}/NAME.npy or .safetensors for {card.images}/NAME; {card.kind} as {card.layout}"
    else:
        yield "image", _image(card)
        yield "output", _output(card)
    if card.labels:
        yield "labels", f"{len(card.labels)}: {', '.join(card.labels)}"
    if card.text is not None:
        text = card.text
        how = [f"{text.context_length} tokens", f"padded with {text.pad_id} to the {text.padding} length"]
        how += ["lower case"] * text.lowercase + ["without punctuation"] * text.strip_punctuation
        how += [f"pooled by {text.pooling}"] * (text.pooling != "none")
        how += [f"channels {text.slice[0]} to {text.slice[1] - 1}"] if text.slice else []
        yield "text", f"{text.onnx}, {text.tokenizer}: {', '.join(how)}"
        yield "prompts", "; ".join(card.prompts.templates)
        yield "score", _score(card)
    yield "licence", card.license
    if card.source:
        yield "source", card.source
    if isinstance(card, Card):
        test = card.selftest
        yield (
            "self-test",
            "none" if test is None else f"an image and {len(test.texts)} texts, within {test.tolerance:g}",
        )


def _image(card: Card) -> str:
    given = card.input
    if given.size:
        size = f"{given.resize} to {given.size[1]} x {given.size[0]}"
    else:
        size = f"any size, brought to multiples of {given.multiple_of}"
        size += f", short side {given.short_side}" if given.short_side else ""
        size += f", long side at most {given.max_side}" if given.max_side else ""
    tile = f", in tiles of {given.tile.size[1]} x {given.tile.size[0]}" if given.tile else ""
    low, high = given.range
    colours = f"0..255 as {low:g}..{high:g}, mean {_list(given.mean)}, std {_list(given.std)}"
    return f"{given.color} {given.layout}, {colours}; {size}{tile}"


def _output(card: Card) -> str:
    out = card.output
    more = [] if out.stride is None else [f"every {out.stride:g} pixels"]
    more += [f"patches of {out.patch} pixels after {out.prefix_tokens} other tokens"] if out.patch else []
    more += [f"vectors in {out.embeddings}, masks by {out.mask_activation}"] if out.embeddings else []
    return ", ".join([f"{out.kind} {out.layout}", *more])


def _score(card: Card | FilesCard) -> str:
    score = card.score
    if score.calibration is not None:
        fit = score.calibration
        named = f" + {fit.classes:.2f} (cosine of class and text - {fit.neutral:.2f})" if fit.classes else ""
        named += f" - {fit.others:.2f} (how surely and by how much another class is nearer)" if fit.others else ""
        formula = f"probability, sigmoid({fit.a:.2f} cosine {fit.b:+.2f}{named})"
        return f"{formula}, fitted on {fit.count:,} of {fit.dataset}, {fit.date}"
    said = {
        "cosine": "cosine",
        "sigmoid": f"sigmoid({score.scale or 1:g} cosine {score.bias:+g})",
        "relevancy": f"relevancy at scale {score.scale or 1:g} against {', '.join(score.negatives)}",
    }[score.kind]
    at = "" if score.threshold is None else f", hits from {score.threshold:g}"
    return f"{said}{at}; not calibrated"


def _list(numbers: tuple[float, ...]) -> str:
    return "[" + ", ".join(f"{n:g}" for n in numbers) + "]"
