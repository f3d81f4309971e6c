"""CUDA C++ compiled for one GPU architecture by NVRTC at run time, cached as files, and launched through the driver (by
ctypes, on torch's current stream)."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path

import torch

from perception.errors import InputError
from perception.io.atomic import write_file
from perception.onnx.store import cache_folder

MAX_FEATURES = 8  # channels that the kernels take at once; more go through in slices
OLDEST_ARCHITECTURE = 75  # Turing
Stream = Callable[[], AbstractContextManager[int]]
THREADS = 256  # of a block, as in kernels.cu
_TOO_NEW = (209, 218, 222)  # no kernel image, invalid PTX, unsupported PTX: the driver is older than the compiler
_FILES = {
    "cuda": ("kernels.cu", "device.h", "prepare.h", "forward.h", "backward.h", "reduce.h", "training.h", "instances.h"),
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
    with suppress(InputError):  # where the folder cannot be written, it is compiled again next time
        write_file(file, cubin)
    return cubin


@functools.cache
def load_driver() -> ctypes.CDLL:
    """The driver's library."""
    try:
        return ctypes.CDLL("libcuda.so.1")
    except OSError:
        raise InputError("no NVIDIA driver was found (libcuda.so.1); install it, or compute on the CPU") from None


class Kernels:
    """Kernels of one module on one device.

    image: a cubin. stream: opens a context in which the device is current, and gives the handle of the stream to launch
    on. RuntimeError names the driver's errors.
    """

    def __init__(self, driver: ctypes.CDLL, image: bytes, stream: Stream):
        self._driver, self._stream, self._module = driver, stream, ctypes.c_void_p()
        self._functions: dict[str, ctypes.c_void_p] = {}
        with stream():
            self._check(driver.cuModuleLoadData(ctypes.byref(self._module), image), "loading the kernels")

    def _check(self, code: int, doing: str) -> None:
        if code == 0:
            return
        text = ctypes.c_char_p()
        self._driver.cuGetErrorString(code, ctypes.byref(text))
        message = text.value.decode(errors="replace") if text.value else "unknown"
        hint = "; the driver is too old for this torch's CUDA: update it" if code in _TOO_NEW else ""
        raise RuntimeError(f"CUDA error {code} in {doing}: {message}{hint}")

    def launch(self, name: str, blocks: int, *arguments: ctypes._SimpleCData | ctypes.Structure) -> None:
        """Launches `name` on `blocks` blocks; the driver copies the arguments, not what they point to."""
        if blocks == 0:
            return
        if name not in self._functions:
            function = ctypes.c_void_p()
            code = self._driver.cuModuleGetFunction(ctypes.byref(function), self._module, name.encode())
            self._check(code, f"looking up {name}")
            self._functions[name] = function
        table = (ctypes.c_void_p * len(arguments))(*[ctypes.addressof(argument) for argument in arguments])
        with self._stream() as stream:
            grid = (blocks, 1, 1, THREADS, 1, 1, 0, ctypes.c_void_p(stream))
            self._check(self._driver.cuLaunchKernel(self._functions[name], *grid, table, None), name)


def device_kernels(options: KernelOptions, device: torch.device) -> Kernels:
    """The kernels on a CUDA device, compiled at first use (seconds; later runs read them from a cache)."""
    if options.double:
        raise InputError("rasterize: the tensors are float64, expected float32 on a CUDA device; call .float()")
    return _device_kernels(options, torch.cuda.current_device() if device.index is None else device.index)


@functools.cache
def _device_kernels(options: KernelOptions, index: int) -> Kernels:
    major, minor = torch.cuda.get_device_capability(index)
    if 10 * major + minor < OLDEST_ARCHITECTURE:
        name = torch.cuda.get_device_name(index)
        raise InputError(f"{name} has compute capability {major}.{minor}, expected 7.5 or more; compute on the CPU")

    @contextmanager
    def switched() -> Iterator[int]:
        with torch.cuda.device(index):
            yield torch.cuda.current_stream().cuda_stream

    def stream() -> AbstractContextManager[int]:
        if torch.cuda.current_device() != index:
            return switched()
        return nullcontext(torch.cuda.current_stream().cuda_stream)  # a switch takes longer than a launch

    return Kernels(load_driver(), cached_kernels(options, 10 * major + minor), stream)
