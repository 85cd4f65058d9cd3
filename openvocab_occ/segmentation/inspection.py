"""What a model file of a stranger refers to, looked at before anything of it runs."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

from openvocab_occ.errors import ModelError, UnsafeFileError

if TYPE_CHECKING:
    import onnx

DOMAINS = frozenset({"", "ai.onnx", "ai.onnx.ml", "com.microsoft"})
"""Operator sets that come with onnxruntime; others would need native code of the model's maker."""
_MAKERS = {"ConstantOfShape": 0, "Expand": 1, "Tile": 1, "Reshape": 1, "Resize": 3}
"""Operators that make a tensor of a size that an input, of this place, states."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What a model may use; the defaults let every model through that fits this kind of work."""

    file_bytes: int = 16 << 30
    """Of the model and its weights together."""
    elements: int = 1 << 30
    """Of one tensor, declared or put out."""
    seconds: float = 120.0
    """Of one run; operators are interrupted between one another, not within."""
    metadata_characters: int = 1_000_000


def inspect_model(path: Path, limits: Limits | None = None) -> tuple[Path, ...]:
    """Return the files of a model, itself first; nothing of it is run and no file it names is opened.

    Raises:
        ModelError: It is no ONNX file, or lacks a file of weights.
        UnsafeFileError: It reaches outside its folder or through links, needs operators that are foreign code, or asks
            for more than the limits.
    """
    import onnx
    from google.protobuf.message import DecodeError

    limits = limits or Limits()
    if not path.is_file():
        raise ModelError(f"model {path} is not a file", expected="an .onnx file", got="a folder")
    size = path.stat().st_size
    if size >= min(2 << 30, limits.file_bytes):  # what a protobuf can hold
        raise UnsafeFileError(
            f"model {path.name} is too large",
            expected=f"below {min(2 << 30, limits.file_bytes):,} bytes",
            got=f"{size:,}",
        )
    try:
        model = onnx.load(str(path), load_external_data=False)
    except (DecodeError, ValueError, OSError, UnicodeDecodeError) as error:
        raise ModelError(f"model {path.name} is not ONNX", expected="an .onnx file", got=first_line(error)) from error
    if not model.graph.node:
        raise ModelError(f"model {path.name} is not ONNX", expected="a graph of operators", got="an empty graph")
    local = {(function.domain, function.name) for function in model.functions}
    files = {path: None}
    for node in _nodes(model):
        if (node.domain not in DOMAINS and (node.domain, node.op_type) not in local) or node.op_type == "EPContext":
            raise UnsafeFileError(
                f"model {path.name} needs the operator {node.domain}.{node.op_type}",
                expected="operators that come with onnxruntime",
                fix="export it without custom operators",
            )
    for tensor in _tensors(model):
        if tensor.external_data or tensor.data_location == onnx.TensorProto.EXTERNAL:
            files[_weights(tensor, path)] = None
    _check_sizes(model, path, tuple(files), limits)
    return tuple(files)


def _check_sizes(model: "onnx.ModelProto", path: Path, files: tuple[Path, ...], limits: Limits) -> None:
    if (size := sum(file.stat().st_size for file in files)) > limits.file_bytes:
        raise UnsafeFileError(
            f"model {path.name} is too large", expected=f"{limits.file_bytes:,} bytes", got=f"{size:,}"
        )
    told = sum(len(entry.key) + len(entry.value) for entry in model.metadata_props)
    if told > limits.metadata_characters:
        raise UnsafeFileError(
            f"model {path.name} carries too much metadata",
            expected=f"at most {limits.metadata_characters:,} characters",
            got=f"{told:,}",
        )
    for what, count in _declared_sizes(model):
        if not 0 <= count <= limits.elements:
            raise UnsafeFileError(
                f"model {path.name} asks for a tensor beyond all measure, {what}",
                expected=f"at most {limits.elements:,} elements",
                got=f"{count:,}" if count >= 0 else "a negative size",
            )


def _declared_sizes(model: "onnx.ModelProto") -> Iterator[tuple[str, int]]:
    """Yield each tensor whose size the file states: weights, declared values, results of making operators."""
    for tensor in _tensors(model):
        yield f"weight {tensor.name!r}", _elements(tensor.dims)
    for graph in _graphs(model):
        values = [v for part in ("input", "output", "value_info") for v in getattr(graph, part, ())]
        for value in values:
            if not isinstance(value, str):  # functions list names only
                shape = value.type.tensor_type.shape
                yield f"value {value.name!r}", prod(d.dim_value or 1 for d in shape.dim)
        constants = {t.name: t for t in getattr(graph, "initializer", ())}
        for node in graph.node:
            if node.op_type == "Constant" and node.output:
                constants |= dict.fromkeys(node.output, next((a.t for a in node.attribute if a.HasField("t")), None))
        constants = {name: tensor for name, tensor in constants.items() if tensor is not None}
        for node in graph.node:
            at = _MAKERS.get(node.op_type)
            if at is not None and at < len(node.input) and node.input[at] in constants:
                sizes = _numbers(constants[node.input[at]])
                yield f"made by {node.op_type}", prod(max(n, 1) if n > -2 else -1 for n in sizes)
            if node.op_type == "Range" and all(name in constants for name in node.input):
                start, stop, step = (_numbers(constants[name])[0] for name in node.input)
                yield "made by Range", max(0, int((stop - start) / step)) if step else 0


def _elements(dims: Any) -> int:
    return -1 if any(n < 0 for n in dims) else prod(dims)


def _numbers(tensor: "onnx.TensorProto") -> list[int]:
    """Return a short constant as integers; nothing for what lies in another file or is no shape."""
    from onnx import numpy_helper

    short = _elements(tensor.dims) in range(17) and not tensor.external_data and not tensor.data_location
    if not short or tensor.data_type not in (1, 6, 7, 11):
        return [1]
    try:
        return [int(n) for n in numpy_helper.to_array(tensor).ravel()] or [1]
    except (ValueError, TypeError, OverflowError):
        return [1]


def _weights(tensor: "onnx.TensorProto", path: Path) -> Path:
    facts = {entry.key: entry.value for entry in tensor.external_data}
    place = facts.get("location", "")
    if not place or place != Path(place).name or place in (".", "..") or "\\" in place or ":" in place:
        raise UnsafeFileError(
            f"model {path.name} refers to a file outside its folder",
            expected="plain names of files beside it",
            got=repr(place),
        )
    file = path.parent / place
    if file.is_symlink():
        raise UnsafeFileError(
            f"model {path.name} has weights behind a link", expected="a plain file beside it", got=repr(place)
        )
    if not file.is_file():
        raise ModelError(f"model {path.name} lacks its weights", expected=f"{place} beside it", got="no such file")
    try:
        end = int(facts.get("offset", 0)) + int(facts.get("length", 0))
    except ValueError as error:
        raise ModelError(f"model {path.name} has weights at no position", got=error) from error
    if not 0 <= end <= file.stat().st_size:
        raise ModelError(
            f"weights {place} of {path.name} are cut off",
            expected=f"at least {end} bytes",
            got=f"{file.stat().st_size} bytes",
        )
    return file


def _graphs(model: "onnx.ModelProto") -> Iterator[Any]:
    """Yield the graph, the functions, and every graph inside an operator's attribute."""
    waiting: list[Any] = [model.graph, *model.functions]
    while waiting:
        graph = waiting.pop()
        yield graph
        for node in graph.node:
            for attribute in node.attribute:
                waiting += [attribute.g] * attribute.HasField("g") + list(attribute.graphs)


def _nodes(model: "onnx.ModelProto") -> Iterator["onnx.NodeProto"]:
    for graph in _graphs(model):
        yield from graph.node


def _tensors(model: "onnx.ModelProto") -> Iterator["onnx.TensorProto"]:
    for graph in _graphs(model):
        yield from getattr(graph, "initializer", ())
        sparse = list(getattr(graph, "sparse_initializer", ()))
        for node in graph.node:
            for attribute in node.attribute:
                yield from [attribute.t] * attribute.HasField("t") + list(attribute.tensors)
                sparse += [attribute.sparse_tensor] * attribute.HasField("sparse_tensor")
                sparse += attribute.sparse_tensors
        for tensor in sparse:
            yield from (tensor.values, tensor.indices)


def first_line(error: Exception) -> str:
    """Return the start of a message of onnxruntime or protobuf; they go on for pages."""
    return str(error).strip().partition("\n")[0][:300]
