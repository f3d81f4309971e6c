"""The CUDA kernels on the CPU: csrc/cuda/emulator.cpp, built by the system's compiler, behind the host side that a GPU
would run. A build takes seconds and serves the whole session."""

from __future__ import annotations

import atexit
import ctypes
import functools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path

import pytest
import torch

from perception.rasterizer import cpu
from perception.rasterizer import device as on_device
from perception.rasterizer.cuda.kernels import KernelOptions, Kernels
from support.rasterizer import grads_and_images, scene

CSRC = Path(__file__).resolve().parents[2] / "csrc"
FLAGS = (
    "-std=c++17", "-march=native", "-ffp-contract=off", "-fPIC", "-shared",
    "-U_FORTIFY_SOURCE",  # its longjmp refuses to go to another stack
)  # fmt: skip
IN_ORDER, REVERSED = 0, 1
KernelsFor = Callable[[KernelOptions, torch.device], Kernels]


def find_compiler() -> str:
    """The system's C++ compiler; the test is skipped where there is none."""
    found = shutil.which(os.environ.get("CXX", "c++")) or shutil.which("g++") or shutil.which("clang++")
    if found is None:
        pytest.skip("no C++ compiler: set CXX or install one to run the CUDA kernels on the CPU")
    return found


@functools.cache
def _folder() -> Path:
    folder = tempfile.mkdtemp(prefix="perception-emulator-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


@functools.cache
def build(options: KernelOptions, *edits: tuple[str, str]) -> ctypes.CDLL:
    """The emulator as a driver library. edits: (found, replaced) of a mutation test, each once in the sources."""
    target = Path(tempfile.mkdtemp(dir=_folder()))
    texts = {file.name: file.read_text() for file in (CSRC / "cuda").iterdir()}
    for edit in edits:
        changed = [name for name, text in texts.items() if edit[0] in text]
        assert len(changed) == 1 and texts[changed[0]].count(edit[0]) == 1, f"not exactly once in the sources: {edit}"
        texts[changed[0]] = texts[changed[0]].replace(*edit)
    for name, text in texts.items():
        (target / name).write_text(text)
    level = "-Og" if edits else "-O1"  # what runs once is compiled in less time
    command = [find_compiler(), *FLAGS, level, *options.defines(), f"-I{CSRC / 'rasterizer'}"]
    subprocess.run([*command, str(target / "emulator.cpp"), "-o", str(target / "emulator.so")], check=True)
    library = ctypes.CDLL(str(target / "emulator.so"))
    _libraries.append(library)
    for begin, size in _memory.items():
        library.emulator_memory(ctypes.c_uint64(begin), ctypes.c_uint64(size))
    return library


_address, _libraries, _memory = on_device._address, list[ctypes.CDLL](), dict[int, int]()


def _address_and_tell(tensor):
    """Tells the emulators which memory the kernels may use: that of every tensor whose address they are given."""
    begin, size = tensor.untyped_storage().data_ptr(), tensor.untyped_storage().nbytes()
    if size:
        _memory.pop(begin, None)
        _memory[begin] = size  # the latest last
        for library in _libraries:
            library.emulator_memory(ctypes.c_uint64(begin), ctypes.c_uint64(size))
    return _address(tensor)


on_device._address = _address_and_tell


def emulated(lanes: int = IN_ORDER, edits: Sequence[tuple[str, str]] = ()) -> KernelsFor:
    """What stands for `device_kernels`. lanes: IN_ORDER, REVERSED or a seed of shuffles."""

    def kernels_for(options: KernelOptions, device: torch.device) -> Kernels:
        driver = build(options, *edits)
        driver.emulator_lane_order(ctypes.c_uint64(lanes))
        return Kernels(driver, b"\x7fELF", lambda: nullcontext(0))

    return kernels_for


@contextmanager
def on_emulator(kernels_for: KernelsFor) -> Iterator[None]:
    """Within it `perception.rasterize` runs the CUDA kernels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(on_device, "device_kernels", kernels_for)
        patch.setattr(cpu, "rasterize_forward", on_device.rasterize_forward)
        patch.setattr(cpu, "rasterize_backward", on_device.rasterize_backward)
        yield


def emulate(inputs, lanes=IN_ORDER, edits=(), **options):
    """`grads_and_images` by the CUDA kernels."""
    with on_emulator(emulated(lanes, edits)):
        return grads_and_images(inputs, **options)


def worst(found, expected):
    """The largest error of any image or gradient, of its largest value; infinite where a mask or NaN differs."""
    errors = []
    for a, b in zip(found, expected, strict=True):
        if a.dtype == torch.bool or not bool(a.isfinite().all()):
            errors.append(0.0 if torch.equal(a, b) else float("inf"))
        elif b.numel():
            errors.append(float((a - b).abs().max()) / (float(b.abs().max()) or 1.0))
    return max(errors)


def wide_scene(**options):
    """Some Gaussians over all of 10 × 13 tiles, listed and summed by whole warps, among others of every size."""
    inputs = scene(**{"n": 80, "width": 200, "height": 150, "cameras": 1, **options})
    inputs["Ks"] = torch.tensor([[[160.0, 0, 107.0], [0, 173.0, 68.0], [0, 0, 1]]], dtype=inputs["means"].dtype)
    inputs["scales"][::10] = 3.0
    inputs["opacities"][::10] *= 0.2
    return inputs
