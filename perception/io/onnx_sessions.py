"""ONNX models in onnxruntime: sessions, types and shapes of inputs and outputs, file fingerprints."""

from __future__ import annotations

import hashlib
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError, missing_extra
from perception.interrupts import uninterrupted

_DTYPES: dict[str, type] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
    "tensor(uint8)": np.uint8,
}
_SIDE_FILES = ("_data", ".data")  # suffixes of external weight files beside the graph
_EDGE = 1 << 20


def open_session(path: Path) -> Any:
    """An InferenceSession on the first of `wanted_providers` that loads; InputError for an invalid ONNX model."""
    try:
        with uninterrupted():  # Ctrl-C inside the import becomes an ImportError
            import onnxruntime
    except ImportError as error:
        raise missing_extra("onnxruntime", "demo") from error
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected an ONNX model")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # `provider_warning` reports a provider that does not load
            return onnxruntime.InferenceSession(str(path), options, providers=wanted_providers())
    except Exception as error:  # onnxruntime's exceptions share no public base class
        first = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
        raise InputError(f"{path}: not an ONNX model that onnxruntime can open ({first})") from error


def wanted_providers() -> list[str]:
    """Execution providers in order: CUDA if this onnxruntime was built with it, then the CPU."""
    import onnxruntime

    available = onnxruntime.get_available_providers()
    return [name for name in ("CUDAExecutionProvider", "CPUExecutionProvider") if name in available]


def provider_warning(path: Path, session: Any) -> str | None:
    """A one-line warning if the best provider did not load, else None: onnxruntime falls back silently."""
    wanted, used = wanted_providers()[0], session.get_providers()[0]
    return None if wanted == used else f"{path.name}: {wanted} did not load, running on {used}"


def dtype_of(value: Any) -> type:
    """numpy type of a session's input or output."""
    return _DTYPES.get(value.type, np.float32)


def shape_of(value: Any) -> list[int | None]:
    """Shape of a session's input or output, None for dynamic axes."""
    return [size if isinstance(size, int) and size > 0 else None for size in value.shape]


def signature(session: Any) -> str:
    """Inputs and outputs with their shapes, for messages."""
    inputs = ", ".join(f"{value.name}{value.shape}" for value in session.get_inputs())
    outputs = ", ".join(f"{value.name}{value.shape}" for value in session.get_outputs())
    return f"inputs {inputs}; outputs {outputs}"


def fingerprint(path: Path) -> str:
    """12 hex digits of the size, the first and the last MiB of a model and of its side files.

    This distinguishes weights without reading the whole files, which can be gigabytes.
    """
    digest = hashlib.sha256()
    for part in (path, *(path.with_name(path.name + suffix) for suffix in _SIDE_FILES)):
        if not part.is_file():
            continue
        size = part.stat().st_size
        digest.update(str(size).encode())
        with part.open("rb") as file:
            digest.update(file.read(_EDGE))
            file.seek(max(0, size - _EDGE))
            digest.update(file.read(_EDGE))
    return digest.hexdigest()[:12]
