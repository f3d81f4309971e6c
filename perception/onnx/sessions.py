"""ONNX models in onnxruntime: their files, sessions, types and shapes of inputs and outputs, fingerprints."""

from __future__ import annotations

import hashlib
import mmap
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError, missing_extra
from perception.interrupts import uninterrupted
from perception.io.documents import brief, read_json

_DTYPES: dict[str, type] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
    "tensor(uint8)": np.uint8,
}
# Suffixes that name the precision of a graph in public exports, the most precise first.
_PRECISIONS = ("", "_fp16", "_quantized", "_q8", "_int8", "_uint8", "_q4f16", "_q4", "_bnb4")
# StringStringEntryProto of TensorProto.external_data, up to the length of its value, in 7 bits a byte.
_LOCATION = re.compile(rb"\x0a\x08location\x12([\x80-\xff]{0,4}[\x00-\x7f])")
_LONGEST = 4096  # bytes of a path
# Absolute, with a drive letter, or with a part "..": by the rules of any operating system.
_LEADS_OUT = re.compile(r"[/\\]|[A-Za-z]:|(.*[/\\])?\.\.([/\\]|$)|$|.*\0", re.DOTALL)
_EDGE = 1 << 20


def model_root(folder: Path) -> Path:
    """The folder itself, or of an entry of the Hugging Face cache the revision that was fetched last."""
    return max(folder.glob("snapshots/*/"), key=lambda path: path.stat().st_mtime, default=folder)


def model_graphs(folder: Path) -> tuple[list[Path], list[Path]]:
    """The ONNX files of a model folder and its subfolders (`onnx/`, `visual/`), and those left out.
    Of files that differ only in precision (`model.onnx`, `model_fp16.onnx`, `model_quantized.onnx`) the most precise
    one is the model's. InputError where there is none."""
    root, best = model_root(folder), dict[tuple[Path, str], Path]()
    found = sorted([*root.glob("*.onnx"), *root.glob("*/*.onnx")], key=lambda path: _PRECISIONS.index(_precision(path)))
    if not found:
        raise InputError(f"{folder}: no .onnx file in this folder; expected ONNX models")
    for path in found:
        best.setdefault((path.parent, graph_name(path)), path)
    return sorted(best.values()), [path for path in found if path not in best.values()]


def graph_name(path: Path) -> str:
    """The file name without suffix and precision."""
    return path.stem.removesuffix(_precision(path))


def _precision(path: Path) -> str:
    return next((suffix for suffix in _PRECISIONS[1:] if path.stem.endswith(suffix)), "")


def side_files(path: Path) -> list[Path]:
    """The files beside an ONNX file that hold its weights, as the graph names them (`external_data`).
    What lies outside the model's folder is not among them."""
    return [path.parent / name for name in _weights(path) if _lies_beside(path, name)]


def refuse_outside_weights(path: Path) -> None:
    """InputError for an ONNX file whose weights lie outside its folder, as no public export has them."""
    for name in _weights(path):
        if not _lies_beside(path, name):
            raise InputError(
                f"{path}: its weights are in {name[:200]!r}, outside its folder; expected a file beside it"
            )


def _weights(path: Path) -> dict[str, None]:
    """Names of the files in order, each once."""
    names = dict[str, None]()
    if path.stat().st_size:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            for match in _LOCATION.finditer(data):
                size = sum((byte & 127) << 7 * number for number, byte in enumerate(match[1]))
                names[data[match.end() : match.end() + min(size, _LONGEST)].decode("utf-8", "replace")] = None
    return names


def _lies_beside(path: Path, name: str) -> bool:
    """Whether a side file is in the folder of the model, also where links lead; in the cache of Hugging Face the model
    and its side files are links into one folder."""
    if _LEADS_OUT.match(name):
        return False
    folders, parents = (path.parent.resolve(), path.resolve().parent), (path.parent / name).resolve().parents
    return any(folder in parents for folder in folders)


def read_config(model: Path, name: str) -> dict[str, Any]:
    """A JSON file in the model's folder or its parent (graphs often lie in `onnx/`); {} if there is none."""
    path = next((folder / name for folder in model.parents[:2] if (folder / name).is_file()), None)
    known = None if path is None else read_json(path)
    return known if isinstance(known, dict) else {}


def open_session(path: Path, threads: int = 0) -> Any:
    """An InferenceSession on the first of `wanted_providers` that loads. threads: of one run; 0: all cores.
    InputError for what is no ONNX model, for missing weights, and for a graph that this onnxruntime cannot run."""
    try:
        with uninterrupted():  # Ctrl-C inside the import becomes an ImportError
            import onnxruntime
    except ImportError as error:
        raise missing_extra("onnxruntime", "demo") from error
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected an ONNX model")
    refuse_outside_weights(path)
    missing = ", ".join(side.name for side in side_files(path) if not side.is_file())
    if missing:
        raise InputError(f"{path}: its weights are in {missing}, not beside it; fetch that file too, by this name")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = threads
    options.enable_mem_pattern = False  # one for each shape of the inputs is kept: 93 MiB with texts of 20 photos
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # waiting threads leave the core to others
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # `provider_warning` reports a provider that does not load
            return onnxruntime.InferenceSession(str(path), options, providers=wanted_providers())
    except Exception as error:  # onnxruntime's exceptions share no public base class
        first = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
        if "NOT_IMPLEMENTED" in first:
            what = f"onnxruntime lacks a kernel for it here ({first})"
            raise InputError(f"{path}: {what}; take full precision") from error
        with path.open("rb") as file:
            pointer = file.read(40).startswith(b"version https://git-lfs")
        if pointer:
            raise InputError(f"{path}: a Git LFS pointer, not the model; fetch it with git lfs pull") from error
        raise InputError(f"{path}: not an ONNX model that onnxruntime can open ({first})") from error


def run_graph(
    path: Path, session: Any, outputs: list[str], feeds: dict[str, np.ndarray], options: Any = None
) -> list[np.ndarray]:
    """The outputs of one run of the model of `path`. InputError where it fails, as on a size that was fixed when it was
    exported, and for NaN, as of half precision that overflows."""
    try:
        found = [np.asarray(output) for output in session.run(outputs, feeds, options)]
    except Exception as error:  # onnxruntime's exceptions share no public base class
        shapes = ", ".join(f"{name}{list(value.shape)}" for name, value in feeds.items())
        raise InputError(f"{path}: fails on {shapes} ({brief(error, 200)}); export it anew") from error
    for name, output in zip(outputs, found, strict=True):
        if output.dtype.kind == "f" and np.isnan(output).any():
            raise InputError(f"{path}: its output {name} holds NaN; take the model in full precision (fp32)")
    return found


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
    sides = (session.get_inputs(), session.get_outputs())
    inputs, outputs = (", ".join(f"{value.name}{value.shape}" for value in side) for side in sides)
    return f"inputs {inputs}; outputs {outputs}"


def fingerprint(path: Path) -> str:
    """12 hex digits of the size, the first and the last MiB of a model and of its side files.
    This distinguishes weights without reading all of them, which can be gigabytes."""
    digest = hashlib.sha256()
    for part in (path, *side_files(path)):
        size = part.stat().st_size
        digest.update(str(size).encode())
        with part.open("rb") as file:
            digest.update(file.read(_EDGE))
            file.seek(max(0, size - _EDGE))
            digest.update(file.read(_EDGE))
    return digest.hexdigest()[:12]
