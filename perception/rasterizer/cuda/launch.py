"""Launches compiled kernels through the CUDA driver, by ctypes, on torch's current stream."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import torch

from perception.errors import InputError
from perception.rasterizer.cuda.compile import OLDEST_ARCHITECTURE, KernelOptions, cached_kernels

Stream = Callable[[], AbstractContextManager[int]]
THREADS = 256  # of a block, as in kernels.cu
_TOO_NEW = (209, 218, 222)  # no kernel image, invalid PTX, unsupported PTX: the driver is older than the compiler


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
    def stream() -> Iterator[int]:
        with torch.cuda.device(index):
            yield torch.cuda.current_stream().cuda_stream

    return Kernels(load_driver(), cached_kernels(options, 10 * major + minor), stream)
