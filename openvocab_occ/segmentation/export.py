"""From a PyTorch module to an ONNX file that says nothing of the machine it was made on, compared with the module.

Needs torch and onnxscript; nothing here is needed to run a model.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from openvocab_occ.errors import MissingExtraError, ModelError
from openvocab_occ.io.files import PathLike, written_file
from openvocab_occ.segmentation.session import Session

if TYPE_CHECKING:
    import onnx
    import torch

LARGEST = 2 << 30
"""Bytes that one ONNX file can hold; larger models keep their weights in a file beside it."""
TOLERANCE = 1e-3
"""Largest difference between PyTorch and ONNX Runtime, as a part of the largest number."""


def export_module(
    module: "torch.nn.Module",
    path: PathLike,
    inputs: Mapping[str, "torch.Tensor"],
    *,
    outputs: Sequence[str],
    dynamic: Mapping[str, Mapping[int, Any]] | None = None,
) -> float:
    """Write a module as ONNX, strip it, and compare it with PyTorch on the same input.

    Args:
        module: In eval mode; called with the inputs in their order.
        path: File to write; whole or not there.
        inputs: Names and examples. An axis that may vary needs an example above 1.
        outputs: Names.
        dynamic: Of each input, axes that may vary, as names or torch.export.Dim.

    Returns:
        The largest difference, as a part of the largest number.

    Raises:
        MissingExtraError: onnxscript is not installed.
        ModelError: ONNX Runtime and PyTorch differ by more than TOLERANCE.
    """
    import torch

    try:
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("exporting needs onnxscript", fix="pip install onnxscript") from error
    import onnx

    shapes = tuple(dict(dynamic[name]) if dynamic and name in dynamic else None for name in inputs)
    with torch.inference_mode():
        wanted = module(*inputs.values())
        program = torch.onnx.export(
            module, tuple(inputs.values()), input_names=list(inputs), output_names=list(outputs),
            dynamic_shapes=shapes if dynamic else None, external_data=False, dynamo=True, verbose=False,
        )  # fmt: skip
    assert program is not None, "dynamo returns the program"
    model = program.model_proto
    strip(model)
    path = Path(path)
    if model.ByteSize() < LARGEST - (1 << 20):
        onnx.checker.check_model(model, full_check=True)
        with written_file(path) as scratch:
            scratch.write_bytes(model.SerializeToString())
    else:
        onnx.save(model, str(path), save_as_external_data=True, location=f"{path.name}.data")
    return compare(path, inputs, wanted if isinstance(wanted, tuple | list) else (wanted,), outputs)


def compare(
    path: Path, inputs: Mapping[str, "torch.Tensor"], wanted: Sequence["torch.Tensor"], outputs: Sequence[str]
) -> float:
    """Return the largest relative difference of what ONNX Runtime gives to what was wanted; raise above TOLERANCE."""
    found = Session(path).run_many(list(outputs), {name: value.numpy() for name, value in inputs.items()})
    worst = 0.0
    for name, ours, theirs in zip(outputs, found, wanted, strict=True):
        reference = theirs.detach().float().numpy()
        if ours.shape != reference.shape:
            raise ModelError(f"{path.name} lost its shape", expected=reference.shape, got=ours.shape)
        off = float(np.abs(ours - reference).max() / max(float(np.abs(reference).max()), 1e-12))
        if off > TOLERANCE:
            raise ModelError(
                f"output {name} of {path.name} is not PyTorch's", expected=f"within {TOLERANCE:g}", got=f"{off:.3g} off"
            )
        worst = max(worst, off)
    return worst


def strip(model: "onnx.ModelProto") -> None:
    """Remove stack traces, paths of source files, comments and names of modules that exporters leave; in place."""
    model.doc_string = ""
    del model.metadata_props[:]
    for function in model.functions:
        _strip_graph(function)
    _strip_graph(model.graph)
    del model.graph.value_info[:]


def _strip_graph(graph: Any) -> None:
    graph.doc_string = ""
    _clear(graph)
    for node in graph.node:
        node.doc_string = ""
        _clear(node)
        for attribute in node.attribute:
            attribute.doc_string = ""
            for inner in ([attribute.g] if attribute.HasField("g") else []) + list(attribute.graphs):
                _strip_graph(inner)
    for part in ("input", "output", "value_info", "initializer"):
        for value in getattr(graph, part, ()):
            if not isinstance(value, str):
                value.doc_string = ""
                _clear(value)


def _clear(message: Any) -> None:
    if hasattr(message, "metadata_props"):
        del message.metadata_props[:]
