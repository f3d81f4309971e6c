"""How the CUDA kernels are compiled, cached and launched, without a GPU: NVRTC where its wheel is installed, and the
emulator as the driver's library."""

from __future__ import annotations

import ctypes
import re
from contextlib import nullcontext

import pytest
import torch

import perception
from perception.rasterizer import cpu
from perception.rasterizer import device as on_device
from perception.rasterizer.cuda import kernels as cuda
from perception.rasterizer.cuda.kernels import KernelOptions, compile_kernels, nvrtc_version
from perception.rasterizer.rasterize import rasterizer_for
from perception.rasterizer.types import Settings
from support.cuda_emulator import build
from support.rasterizer import passed, scene

OPTIONS = KernelOptions(8, True, True)
KERNELS = {"project_kernel", "count_kernel", "emit_kernel", "forward_kernel", "backward_kernel", "reduce_kernel"}


@pytest.fixture
def nvrtc() -> ctypes.CDLL:
    try:
        return cuda.load_nvrtc()
    except perception.InputError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("architecture", [75, 80, 86, 89, 90, 100, 120])
def test_nvrtc_compiles_every_architecture_with_hardly_a_spill(nvrtc, architecture):
    if architecture >= 100 and nvrtc_version(nvrtc) < (12, 8):
        pytest.skip("this NVRTC is older than Blackwell")
    cubin, log = compile_kernels(nvrtc, OPTIONS, architecture, "--ptxas-options=-v")
    assert cubin.startswith(b"\x7fELF") and all(name.encode() in cubin for name in KERNELS)
    spills = re.findall(r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads", log)
    assert len(spills) >= len(KERNELS) and max(int(n) for numbers in spills for n in numbers) <= 16
    # 128 registers let two blocks of 256 threads run on a multiprocessor.
    assert max(int(n) for n in re.findall(r"Used (\d+) registers", log)) <= 128
    assert max(int(n) for n in re.findall(r"(\d+) bytes smem", log)) <= 48 << 10


def test_nvrtc_reports_what_it_refuses(nvrtc, monkeypatch):
    with pytest.raises(RuntimeError, match=r"do not compile for sm_12: "):
        compile_kernels(nvrtc, OPTIONS, 12)
    monkeypatch.setattr(cuda, "sources", lambda: {"kernels.cu": "int main( {"})
    with pytest.raises(RuntimeError, match=r"kernels.cu\(1\): error"):
        compile_kernels(nvrtc, OPTIONS, 89)


def test_without_nvrtc_the_package_to_install_is_named(monkeypatch):
    def nothing(name):
        raise OSError(name)

    monkeypatch.setattr(cuda.sys, "path", [])
    monkeypatch.setattr(cuda.ctypes, "CDLL", nothing)
    monkeypatch.setattr(torch.version, "cuda", "12.8")
    with pytest.raises(perception.InputError, match="pip install nvidia-cuda-nvrtc-cu12"):
        cuda.load_nvrtc.__wrapped__()
    monkeypatch.setattr(cuda.ctypes, "CDLL", nothing)
    with pytest.raises(perception.InputError, match=r"no NVIDIA driver was found \(libcuda.so.1\)"):
        cuda.load_driver.__wrapped__()


def test_machine_code_is_compiled_once_for_each_source_option_and_architecture(tmp_path, monkeypatch):
    compiled = []

    def compile_once(_, options, architecture):
        compiled.append((options, architecture))
        return f"cubin {len(compiled)}".encode(), ""

    texts = {"kernels.cu": "a"}
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cuda, "load_nvrtc", lambda: None)
    monkeypatch.setattr(cuda, "nvrtc_version", lambda _: (12, 9))
    monkeypatch.setattr(cuda, "compile_kernels", compile_once)
    monkeypatch.setattr(cuda, "sources", lambda: texts)
    first = cuda.cached_kernels(OPTIONS, 89)
    assert cuda.cached_kernels(KernelOptions(8, True, True), 89) == first == b"cubin 1"
    for options, architecture in ((OPTIONS, 90), (KernelOptions(5, True, True), 89)):
        assert cuda.cached_kernels(options, architecture) != first
    texts["kernels.cu"] = "b"
    assert cuda.cached_kernels(OPTIONS, 89) == b"cubin 4"
    assert len(list((tmp_path / "perception" / "cuda").iterdir())) == 4
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))  # a folder that cannot be made
    assert cuda.cached_kernels(OPTIONS, 89) == b"cubin 5"


def test_a_real_cubin_goes_through_the_driver_path(nvrtc, monkeypatch):
    cubin, _ = compile_kernels(nvrtc, OPTIONS, 89)
    kernels = cuda.Kernels(build(KernelOptions(5, True, True, double=True)), cubin, lambda: nullcontext(0))
    inputs = scene(n=50)
    arguments = passed(inputs), Settings(inputs["width"], inputs["height"])
    monkeypatch.setattr(on_device, "device_kernels", lambda *_: kernels)
    found = on_device.rasterize_forward(*arguments)
    torch.testing.assert_close(found.colors, cpu.rasterize_forward(*arguments).colors, rtol=1e-12, atol=1e-12)


def test_what_a_device_cannot_do_is_refused(monkeypatch):
    gpu = torch.device("cuda", 0)
    assert rasterizer_for(gpu) is on_device and rasterizer_for(torch.device("cpu")) is cpu
    with pytest.raises(perception.InputError, match="the tensors are float64, expected float32 on a CUDA device"):
        cuda.device_kernels(KernelOptions(8, True, True, double=True), gpu)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda _: (6, 1))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "GTX 1080")
    with pytest.raises(perception.InputError, match=r"GTX 1080 has compute capability 6.1, expected 7.5 or more"):
        cuda.device_kernels(OPTIONS, gpu)
    inputs = scene()
    with pytest.raises(perception.InputError, match="quats is on meta, expected cpu, where means are"):
        perception.rasterize(**{**inputs, "quats": inputs["quats"].to("meta")})
    with pytest.raises(perception.InputError, match="means is on meta, expected cpu or cuda"):
        perception.rasterize(**{**inputs, "means": inputs["means"].to("meta")})
