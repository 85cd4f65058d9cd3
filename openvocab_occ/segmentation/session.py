"""Opening ONNX files of strangers: what a file refers to is looked at before anything of it runs."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from openvocab_occ.errors import ConfigError, ModelError, UnsafeFileError
from openvocab_occ.io.files import PathLike, existing

if TYPE_CHECKING:
    import onnx
    import onnxruntime

DOMAINS = frozenset({"", "ai.onnx", "ai.onnx.ml", "com.microsoft"})
"""Operator sets that come with onnxruntime; others would need native code of the model's maker."""
_DTYPES = {
    "tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8, "tensor(int32)": np.int32, "tensor(int64)": np.int64,
}  # fmt: skip


@dataclass(frozen=True)
class Port:
    """A declared input or output."""

    name: str
    dtype: str
    """As onnxruntime writes it, such as tensor(float)."""
    shape: tuple[int | None, ...]
    """None where it is not fixed."""

    @property
    def numpy(self) -> type[np.generic] | None:
        """The dtype of its arrays; None for kinds we do not feed."""
        return _DTYPES.get(self.dtype)

    def __str__(self) -> str:
        return f"{self.name} {self.dtype}[{', '.join('?' if n is None else str(n) for n in self.shape)}]"


class Session:
    """A model file that was found harmless, ready to run."""

    def __init__(
        self, path: PathLike, *, providers: Sequence[str] = ("CPUExecutionProvider",), threads: int | None = None
    ) -> None:
        self.path = existing(path, "ONNX model")
        self.files = inspect_model(self.path)
        self._session = _open(self.path, providers, threads)
        self.inputs = tuple(_port(i) for i in self._session.get_inputs())
        self.outputs = tuple(_port(o) for o in self._session.get_outputs())

    def input(self, name: str | None) -> Port:
        """Return the input of this name, or the only one."""
        return _pick(self.inputs, name, "input", self.path)

    def output(self, name: str | None) -> Port:
        """Return the output of this name, or the only one."""
        return _pick(self.outputs, name, "output", self.path)

    def run(self, output: str, feeds: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return one output as a finite array; ModelError if the model fails or puts out NaN."""
        try:
            (found,) = self._session.run([output], dict(feeds))
        except _runtime_errors() as error:
            shapes = ", ".join(f"{name} {array.shape}" for name, array in feeds.items())
            raise ModelError(f"model {self.path.name} failed on {shapes}", got=_first_line(error)) from error
        if not isinstance(found, np.ndarray) or found.dtype.kind not in "fiub":
            raise ModelError(f"output {output} of {self.path.name} is no tensor of numbers", got=type(found).__name__)
        if found.dtype.kind == "f" and not np.isfinite(found).all():
            bad = int(found.size - np.isfinite(found).sum())
            raise ModelError(
                f"output {output} of {self.path.name} is not finite",
                expected="numbers",
                got=f"{bad} of {found.size} values NaN or infinite",
                fix="do range, mean and std of the card fit the model?",
            )
        return found


def inspect_model(path: Path) -> tuple[Path, ...]:
    """Return the files of a model, itself first; nothing of it is run and no file it names is opened.

    Raises:
        ModelError: It is no ONNX file, or lacks a file of weights.
        UnsafeFileError: It reaches outside its folder or through links, or needs operators that are foreign code.
    """
    import onnx
    from google.protobuf.message import DecodeError

    if not path.is_file():
        raise ModelError(f"model {path} is not a file", expected="an .onnx file", got="a folder")
    try:
        model = onnx.load(str(path), load_external_data=False)
    except (DecodeError, ValueError, OSError, UnicodeDecodeError) as error:
        raise ModelError(f"model {path.name} is not ONNX", expected="an .onnx file", got=_first_line(error)) from error
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
    return tuple(files)


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


def _open(path: Path, providers: Sequence[str], threads: int | None) -> "onnxruntime.InferenceSession":
    import onnxruntime

    there = onnxruntime.get_available_providers()
    if missing := [name for name in providers if name not in there]:
        raise ConfigError(f"onnxruntime has no {', '.join(missing)}", expected=" or ".join(there))
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    if threads is not None:
        options.intra_op_num_threads = threads
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=list(providers))
    except _runtime_errors() as error:
        raise ModelError(f"onnxruntime cannot open {path.name}", got=_first_line(error)) from error


def _runtime_errors() -> tuple[type[Exception], ...]:
    from importlib import import_module

    state = import_module("onnxruntime.capi.onnxruntime_pybind11_state")

    kinds = [k for k in vars(state).values() if isinstance(k, type) and issubclass(k, Exception)]
    return (*kinds, RuntimeError, ValueError)


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0][:300]


def _port(declared: Any) -> Port:
    shape = tuple(n if isinstance(n, int) and n > 0 else None for n in declared.shape)
    return Port(declared.name, declared.type, shape)


def _pick(ports: Sequence[Port], name: str | None, what: str, path: Path) -> Port:
    found = [p for p in ports if name in (None, p.name)]
    if len(found) != 1:
        raise ModelError(
            f"{what} of {path.name} does not fit its card",
            expected=f"one {what}" if name is None else f"an {what} called {name}",
            got="; ".join(map(str, ports)),
            fix=f"write {what}.name in the card",
        )
    return found[0]
