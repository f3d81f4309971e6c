"""onnxruntime sessions opened with care: what is no model, or ran on another device than asked, is said."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from perception.errors import InputError, missing_extra

Device = Literal["auto", "cpu", "cuda"]
_DTYPES: dict[str, type] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
}
_SIDECARS = ("_data", ".data")
_EDGE = 1 << 20


def open_session(path: Path, device: Device = "auto") -> Any:
    """An InferenceSession on CUDA when asked or available, else on the CPU; InputError where that cannot
    be.
    """
    try:
        import onnxruntime as ort
    except ImportError as error:
        raise missing_extra("onnxruntime", "demo") from error
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected an ONNX model")
    cuda = device == "cuda" or (device == "auto" and "CUDAExecutionProvider" in ort.get_available_providers())
    providers = ["CUDAExecutionProvider"] * cuda + ["CPUExecutionProvider"]
    options = ort.SessionOptions()
    options.log_severity_level = 3
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a provider that is absent is judged below, on the session itself
            session = ort.InferenceSession(str(path), options, providers=providers)
    except Exception as error:  # onnxruntime's exceptions share no public base class
        first = str(error).strip().splitlines()[0][:160]
        raise InputError(f"{path}: onnxruntime cannot open it as an ONNX model ({first})") from error
    check_provider(path, session.get_providers(), device, cuda)
    return session


def check_provider(path: Path, used: Sequence[str], device: Device, wanted_cuda: bool) -> None:
    """onnxruntime falls back to the CPU without a word; an explicit "cuda" makes that an error, "auto" a
    warning.
    """
    if not wanted_cuda or "CUDAExecutionProvider" in used:
        return
    if device == "cuda":
        raise InputError(
            f"{path}: device cuda asked for, onnxruntime runs it on {', '.join(used)}; "
            "install onnxruntime-gpu with a matching CUDA, or choose cpu"
        )
    warnings.warn(f"{path}: the CUDA provider did not load, running on the CPU", RuntimeWarning, stacklevel=3)


def dtype_of(value: Any) -> type:
    """numpy type of a session's input or output."""
    return _DTYPES.get(value.type, np.float32)


def shape_of(value: Any) -> list[int | None]:
    """Shape of a session's input or output, None where it is dynamic."""
    return [d if isinstance(d, int) and d > 0 else None for d in value.shape]


def fingerprint(path: Path) -> str:
    """12 hex digits from a model's size, first and last MiB and side files: cheap for gigabytes, new for new
    weights.
    """
    digest = hashlib.sha256()
    for part in (path, *(path.with_name(path.name + suffix) for suffix in _SIDECARS)):
        if not part.is_file():
            continue
        size = part.stat().st_size
        digest.update(str(size).encode())
        with part.open("rb") as file:
            digest.update(file.read(_EDGE))
            file.seek(max(0, size - _EDGE))
            digest.update(file.read(_EDGE))
    return digest.hexdigest()[:12]


def signature(session: Any) -> str:
    """Inputs and outputs with their shapes, for messages."""
    ins = ", ".join(f"{i.name}{i.shape}" for i in session.get_inputs())
    outs = ", ".join(f"{o.name}{o.shape}" for o in session.get_outputs())
    return f"inputs {ins}; outputs {outs}"
