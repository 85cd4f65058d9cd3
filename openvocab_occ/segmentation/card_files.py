"""Cards as files: YAML beside a model, JSON inside it, and messages that name the slip."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import msgspec
import yaml

from openvocab_occ.errors import CardError
from openvocab_occ.io.files import PathLike, existing, sha256, written_file
from openvocab_occ.segmentation.card import Card, FilesCard

SHIPPED = Path(__file__).parent / "cards"
"""Cards of public models, found by the sha256 of the model."""
METADATA_KEY = "openvocab_occ.card"
"""Under which a model file may carry its card, as JSON."""
MAX_CHARACTERS = 1_000_000
CONFIRM = "CONFIRM"
"""What a draft says where nobody can know."""
TEMPLATE = """\
schema: 1
name: my model
contract: logits                # or dense, tokens, masks, crops, with a text section
input: {layout: NCHW, color: RGB, range: [0, 1], mean: [0, 0, 0], std: [1, 1, 1], size: [height, width]}
output: {layout: NCHW, kind: logits}   # logits, probabilities, classes; features for dense
labels: [background, road, ...]"""

AnyCard = Card | FilesCard


def read_card(path: PathLike) -> AnyCard:
    """Read a card in YAML, of which JSON is a part.

    Raises CardError that names the file, the key, what was expected and what was found.
    """
    file = existing(path, "model card")
    return parse_card(file.read_bytes(), f"card {file}")


def parse_card(content: bytes | str, where: str) -> AnyCard:
    """Read a card from text; `where` names it in errors."""
    if len(content) > MAX_CHARACTERS:
        raise CardError(f"{where} is not usable", expected=f"at most {MAX_CHARACTERS} characters", got=len(content))
    try:
        fields = yaml.safe_load(content)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise CardError(f"{where} is not YAML", got=" ".join(str(error).split())) from error
    if not isinstance(fields, Mapping):
        raise CardError(f"{where} is not usable", expected="a mapping of fields", got=type(fields).__name__)
    if open_ := list(_unconfirmed(fields)):
        raise CardError(
            f"{where} is a draft: {', '.join(open_)} must be confirmed",
            expected="values from whoever trained the model",
            got=CONFIRM,
            fix="look them up, and check by `model check` and a picture",
        )
    kind = FilesCard if fields.get("contract") == "files" else Card
    try:
        return msgspec.convert(dict(fields), kind)
    except msgspec.ValidationError as error:
        raise _explain(where, str(error), fields, kind) from None


def find_card(model: Path, embedded: str | None = None) -> tuple[AnyCard, Path]:
    """Return the card beside a model (`name.card.yaml` for `name.onnx`), else the one inside it, else the shipped one.

    The second value is the folder that files named in the card lie in. `embedded` is what the model carries.
    """
    beside = model.with_suffix(".card.yaml")
    if beside.is_file():
        return read_card(beside), beside.parent
    if embedded is not None:
        return parse_card(embedded, f"card inside {model.name}"), model.parent
    digest = sha256(model)
    for file in sorted(SHIPPED.glob("*.card.yaml")):
        card = read_card(file)
        if isinstance(card, Card) and card.sha256 == digest:
            return card, file.parent
    raise CardError(
        f"model {model.name} has no card: how to feed it and what its output means is not told",
        expected=f"{beside}, or a card passed by name",
        fix=f"draft one with `openvocab-occ model probe {model.name}`, or write these fields:\n{TEMPLATE}",
    )


def write_card(card: AnyCard, path: PathLike, *, comment: str = "") -> None:
    """Write a card as YAML, only with what differs from the defaults; the file is whole or not there."""
    fields = _plain(card)
    text = yaml.safe_dump(fields, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True)
    with written_file(path) as scratch:
        scratch.write_text("".join(f"# {line}\n" for line in comment.splitlines()) + text)


def embed_card(card: AnyCard, model: PathLike) -> None:
    """Put a card into a model file, so that one file travels; external weights stay where they are."""
    import onnx

    path = existing(model, "ONNX model")
    content = onnx.load(str(path), load_external_data=False)
    kept = [entry for entry in content.metadata_props if entry.key != METADATA_KEY]
    del content.metadata_props[:]
    content.metadata_props.extend(kept)
    fields = {key: value for key, value in _plain(card).items() if key != "sha256"}  # a file cannot hold its own
    content.metadata_props.add(key=METADATA_KEY, value=msgspec.json.encode(fields).decode())
    with written_file(path) as scratch:
        scratch.write_bytes(content.SerializeToString())


def _plain(value: Any) -> Any:
    """Return a card as plain lists and dicts without what is at its default."""
    if isinstance(value, msgspec.Struct):
        pairs = ((field, getattr(value, field.name)) for field in msgspec.structs.fields(value))
        order = {"schema": 0, "name": 1, "contract": 2, "input": 3, "output": 4}
        kept = {f.name: _plain(v) for f, v in pairs if f.required or v != f.default}
        return dict(sorted(kept.items(), key=lambda item: order.get(item[0], 9)))
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def _unconfirmed(value: Any, place: str = "") -> list[str]:
    if isinstance(value, Mapping):
        return [p for key, inner in value.items() for p in _unconfirmed(inner, f"{place}.{key}".lstrip("."))]
    if isinstance(value, list):
        return [p for item in value for p in _unconfirmed(item, place)]
    return [place] if isinstance(value, str) and value.startswith(CONFIRM) else []


def _explain(where: str, message: str, content: Mapping[Any, Any], kind: type[msgspec.Struct]) -> CardError:
    """Turn a message such as ``Expected `int`, got `str` - at `$.input.size` `` into ours."""
    what, _, place = message.partition(" - at `$")
    place = place.strip("`").lstrip(".").removesuffix("[...]")
    if found := re.fullmatch(r"Object contains unknown field `(.*)`", what):
        key = f"{place}.{found[1]}".lstrip(".")
        known = ", ".join(field.name for field in msgspec.structs.fields(_struct(kind, place)))
        return CardError(f"{where} has the unknown key {key!r}", expected=f"one of {known}", fix="is it misspelt?")
    if found := re.fullmatch(r"Object missing required field `(.*)`", what):
        key = f"{place}.{found[1]}".lstrip(".")
        return CardError(f"{where} lacks the key {key!r}", expected=_describe(kind, place, found[1]))
    if found := re.fullmatch(r"Expected `(.*)`, got `(.*)`", what):
        return CardError(f"{where} has a wrong value at {place!r}", expected=found[1], got=found[2])
    what = what.removeprefix("Invalid enum value ")
    if place and not what.startswith("`") and "`" not in what.split(" ")[0]:
        wanted = _describe(kind, *place.rpartition(".")[::2])
        return CardError(f"{where} has a wrong value at {place!r}", expected=wanted, got=what)
    return CardError(f"{where} contradicts itself: {what}")


def _struct(kind: type[msgspec.Struct], place: str) -> type[msgspec.Struct]:
    """Return the section that a place such as `text.inputs` names."""
    for key in filter(None, re.sub(r"\[\d*\]", "", place).split(".")):
        field = next((f for f in msgspec.structs.fields(kind) if f.name == key), None)
        options = () if field is None else (field.type, *get_args(field.type))
        kind = next((o for o in options if isinstance(o, type) and issubclass(o, msgspec.Struct)), kind)
    return kind


def _describe(kind: type[msgspec.Struct], place: str, key: str) -> str:
    """Say what a field wants, from its type."""
    kinds = {field.name: field.type for field in msgspec.structs.fields(_struct(kind, place))}
    wanted = kinds.get(key.split("[")[0])
    options = getattr(wanted, "__args__", ())
    if options and all(isinstance(option, str | int) for option in options):
        return " or ".join(map(str, options))
    if isinstance(wanted, type) and issubclass(wanted, msgspec.Struct):
        return "a section with " + ", ".join(f.name for f in msgspec.structs.fields(wanted))
    return str(wanted).replace("typing.", "").replace("<class '", "").replace("'>", "")
