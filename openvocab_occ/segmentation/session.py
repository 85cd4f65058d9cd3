"""Running ONNX files of strangers: inspected first, then bounded in time and in what they put out."""

import threading
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from openvocab_occ.errors import ConfigError, ModelError
from openvocab_occ.io.files import PathLike, existing
from openvocab_occ.segmentation.card_files import METADATA_KEY
from openvocab_occ.segmentation.inspection import Limits as Limits
from openvocab_occ.segmentation.inspection import first_line
from openvocab_occ.segmentation.inspection import inspect_model as inspect_model

if TYPE_CHECKING:
    import onnxruntime

CPU = "CPUExecutionProvider"
PROVIDERS = {"cpu": CPU, "cuda": "CUDAExecutionProvider", "tensorrt": "TensorrtExecutionProvider"}
"""Short names; onnxruntime's own names are taken too."""
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
        self,
        path: PathLike,
        *,
        providers: Sequence[str] = (CPU,),
        threads: int | None = None,
        limits: Limits | None = None,
    ) -> None:
        self.path = existing(path, "ONNX model")
        self.limits = limits or Limits()
        self.files = inspect_model(self.path, self.limits)
        self._session = _open(self.path, providers, threads)
        self.providers: tuple[str, ...] = tuple(self._session.get_providers())
        """What it runs on, best first."""
        self.inputs = tuple(_port(i) for i in self._session.get_inputs())
        self.outputs = tuple(_port(o) for o in self._session.get_outputs())
        self.embedded_card: str | None = self._session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)

    def input(self, name: str | None) -> Port:
        """Return the input of this name, or the only one."""
        return _pick(self.inputs, name, "input", self.path)

    def output(self, name: str | None) -> Port:
        """Return the output of this name, or the only one."""
        return _pick(self.outputs, name, "output", self.path)

    def run(self, output: str, feeds: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return one output as a finite array; ModelError if the model fails, takes too long, or puts out NaN."""
        return self.run_many([output], feeds)[0]

    def run_many(self, outputs: Sequence[str], feeds: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        """Return several outputs of one run, each checked as by `run`."""
        import onnxruntime

        options = onnxruntime.RunOptions()
        late = threading.Timer(self.limits.seconds, setattr, (options, "terminate", True))
        late.daemon = True
        late.start()
        try:
            found = self._session.run(list(outputs), dict(feeds), options)
        except (*_runtime_errors(), MemoryError) as error:
            if options.terminate:
                raise ModelError(
                    f"model {self.path.name} was stopped",
                    expected=f"a run within {self.limits.seconds:g} s",
                    got="no end",
                    fix="is it meant for such large images?",
                ) from error
            shapes = ", ".join(f"{name} {array.shape}" for name, array in feeds.items())
            raise ModelError(f"model {self.path.name} failed on {shapes}", got=first_line(error)) from error
        finally:
            late.cancel()
        return [self._checked(name, value) for name, value in zip(outputs, found, strict=True)]

    def _checked(self, output: str, found: Any) -> np.ndarray:
        if not isinstance(found, np.ndarray) or found.dtype.kind not in "fiub":
            raise ModelError(f"output {output} of {self.path.name} is no tensor of numbers", got=type(found).__name__)
        if found.size > self.limits.elements:
            raise ModelError(
                f"output {output} of {self.path.name} is too large",
                expected=f"at most {self.limits.elements:,} numbers",
                got=f"{found.size:,}",
            )
        if found.dtype.kind == "f" and not np.isfinite(found).all():
            bad = int(found.size - np.isfinite(found).sum())
            raise ModelError(
                f"output {output} of {self.path.name} is not finite",
                expected="numbers",
                got=f"{bad} of {found.size} values NaN or infinite",
                fix="do range, mean and std of the card fit the model?",
            )
        return found


def chosen_providers(asked: Sequence[str]) -> list[str]:
    """Return onnxruntime's names of what was asked for and is there; warn where only the processor is left.

    Raises ConfigError for a name that onnxruntime does not know.
    """
    import onnxruntime

    known, there = onnxruntime.get_all_providers(), onnxruntime.get_available_providers()
    names = [PROVIDERS.get(name.lower(), name) for name in asked]
    if unknown := [name for name in names if name not in known]:
        raise ConfigError(
            f"onnxruntime has no {', '.join(unknown)}", expected=" or ".join([*PROVIDERS, *there]), got=list(asked)
        )
    if missing := [name for name in names if name not in there]:
        warnings.warn(
            f"this onnxruntime has no {', '.join(missing)}; falling back to {CPU}. "
            "The package onnxruntime-gpu, in place of onnxruntime, has CUDA and TensorRT.",
            RuntimeWarning,
            stacklevel=2,
        )
    kept = [name for name in names if name in there]
    return kept if CPU in kept else [*kept, CPU]


def _open(path: Path, providers: Sequence[str], threads: int | None) -> "onnxruntime.InferenceSession":
    import onnxruntime

    if threads is not None and threads < 1:
        raise ConfigError("threads is not usable", expected="at least 1", got=threads)
    wanted = chosen_providers(providers)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    if threads is not None:
        options.intra_op_num_threads = threads
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=wanted)
    except (*_runtime_errors(), MemoryError) as error:
        raise ModelError(f"onnxruntime cannot open {path.name}", got=first_line(error)) from error
    if wanted[0] not in session.get_providers():  # its libraries could not be loaded
        warnings.warn(f"{wanted[0]} did not start; {path.name} runs on {session.get_providers()[0]}", RuntimeWarning)
    return session


def _runtime_errors() -> tuple[type[Exception], ...]:
    from importlib import import_module

    state = import_module("onnxruntime.capi.onnxruntime_pybind11_state")

    kinds = [k for k in vars(state).values() if isinstance(k, type) and issubclass(k, Exception)]
    return (*kinds, RuntimeError, ValueError)


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
