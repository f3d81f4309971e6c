"""CUDA C++ to the machine code of one GPU architecture, by NVRTC at run time; the results are cached as files."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import sys
from dataclasses import dataclass
from pathlib import Path

from perception.errors import InputError
from perception.io.atomic import atomic_file
from perception.onnx.store import cache_folder

MAX_FEATURES = 8  # channels that the kernels take at once; more go through in slices
OLDEST_ARCHITECTURE = 75  # Turing
_FILES = {
    "cuda": ("kernels.cu", "device.h", "prepare.h", "forward.h", "backward.h", "reduce.h"),
    "rasterizer": ("constants.h", "projection_math.h", "spherical_harmonics.h"),
}
_CMATH = "#pragma once\nnamespace std { using ::sqrt; using ::fabs; }\n"  # NVRTC has the functions, but no headers


@dataclass(frozen=True)
class KernelOptions:
    """What the kernels are compiled for: the feature channels of one slice (0 to MAX_FEATURES), with their variance or
    without, with depth or without; float64 in tests only."""

    features: int
    variance: bool
    depth: bool
    double: bool = False

    def defines(self) -> list[str]:
        """The compiler's options."""
        real = "double" if self.double else "float"
        values = {"REAL": real, "NF": self.features, "VARIANCE": int(self.variance), "DEPTH": int(self.depth)}
        return [f"-D{name}={value}" for name, value in values.items()]


@functools.cache
def sources() -> dict[str, str]:
    """Name -> text of kernels.cu and all it includes: from the installed package, or from the tree."""
    installed, tree = Path(__file__).parent / "csrc", Path(__file__).parents[3] / "csrc"
    root = installed if installed.is_dir() else tree
    files = [root / folder / name for folder, names in _FILES.items() for name in names]
    return {"cmath": _CMATH} | {file.name: file.read_text(encoding="utf-8") for file in files}


@functools.cache
def load_nvrtc() -> ctypes.CDLL:
    """NVRTC of the CUDA that torch was built with, else any: a library of the system, or of an installed wheel."""
    import torch

    own = (torch.version.cuda or "13").split(".")[0]
    for major in dict.fromkeys((own, "13", "12")):
        name = f"libnvrtc.so.{major}"
        wheels = [file for folder in sys.path for file in sorted(Path(folder).glob(f"nvidia/*/lib/{name}"))]
        for file in [*wheels, name]:
            try:
                return ctypes.CDLL(str(file))
            except OSError:
                continue
    package = "nvidia-cuda-nvrtc" + ("-cu12" if own == "12" else "")
    raise InputError(f"the GPU's kernels need NVRTC, which was not found; run: pip install {package}")


def nvrtc_version(nvrtc: ctypes.CDLL) -> tuple[int, int]:
    """(major, minor)."""
    major, minor = ctypes.c_int(), ctypes.c_int()
    nvrtc.nvrtcVersion(ctypes.byref(major), ctypes.byref(minor))
    return major.value, minor.value


def compile_kernels(nvrtc: ctypes.CDLL, options: KernelOptions, architecture: int, *more: str) -> tuple[bytes, str]:
    """(machine code for compute capability `architecture`, such as 89, and the compiler's log).

    RuntimeError with the compiler's first message if it refuses: a new or old NVRTC does not know every architecture.
    """
    texts = sources()
    names, bodies = ((ctypes.c_char_p * len(texts))(*map(str.encode, part)) for part in (texts, texts.values()))
    program = ctypes.c_void_p()
    nvrtc.nvrtcCreateProgram(
        ctypes.byref(program), texts["kernels.cu"].encode(), b"kernels.cu", len(texts), bodies, names
    )
    arguments = [f"--gpu-architecture=sm_{architecture}", "--std=c++17", *options.defines(), *more]
    table = (ctypes.c_char_p * len(arguments))(*map(str.encode, arguments))
    try:
        failed = nvrtc.nvrtcCompileProgram(program, len(arguments), table)
        log = _output(nvrtc, program, "ProgramLog").rstrip(b"\0").decode(errors="replace")
        if failed:
            first = next((line for line in log.splitlines() if "error" in line), f"NVRTC error {failed}")
            raise RuntimeError(f"the GPU's kernels do not compile for sm_{architecture}: {first}")
        return _output(nvrtc, program, "CUBIN"), log
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(program))


def _output(nvrtc: ctypes.CDLL, program: ctypes.c_void_p, what: str) -> bytes:
    size = ctypes.c_size_t()
    getattr(nvrtc, f"nvrtcGet{what}Size")(program, ctypes.byref(size))
    text = ctypes.create_string_buffer(max(size.value, 1))
    getattr(nvrtc, f"nvrtcGet{what}")(program, text)
    return text.raw[: size.value]


def cached_kernels(options: KernelOptions, architecture: int) -> bytes:
    """As `compile_kernels`, read from the cache where the same sources were compiled for the same before."""
    nvrtc = load_nvrtc()
    parts = [*sources().items(), options.defines(), architecture, nvrtc_version(nvrtc)]
    file = cache_folder() / "cuda" / f"{hashlib.sha256(repr(parts).encode()).hexdigest()[:32]}.cubin"
    if file.is_file():
        return file.read_bytes()
    cubin, _ = compile_kernels(nvrtc, options, architecture)
    with contextlib.suppress(OSError, InputError), atomic_file(file) as part:
        part.write_bytes(cubin)  # where the folder cannot be written, it is compiled again next time
    return cubin
