"""Compiles the CUDA kernels without a GPU: instructions, registers and shared memory of each.

pip install nvidia-cuda-nvrtc-cu12
python tools speed.cuda_statics
"""

from __future__ import annotations

import re
import struct

from perception.rasterizer.cuda.kernels import KernelOptions, compile_kernels, load_nvrtc, nvrtc_version

ARCHITECTURES = (75, 80, 86, 89, 90, 100, 120)
BYTES = 16
"""Of an instruction, since compute capability 7.0."""


def instructions(cubin: bytes) -> dict[str, int]:
    """Of each kernel: the sections .text.NAME of a 64-bit ELF file, with the padding at their ends."""
    table, entry, count, names = struct.unpack_from("<40xQ10xHHH", cubin)[:4]
    sections = [struct.unpack_from("<IIQQQQ", cubin, table + entry * number) for number in range(count)]
    texts = sections[names][4]
    found = {}
    for name, *_, size in sections:
        word = cubin[texts + name : cubin.index(b"\0", texts + name)].decode()
        if word.startswith(".text."):
            found[word[6:]] = size // BYTES
    return found


def main() -> None:
    nvrtc = load_nvrtc()
    version = ".".join(map(str, nvrtc_version(nvrtc)))
    print(f"NVRTC {version}; colours, depth, 8 features and their variance")
    for architecture in ARCHITECTURES:
        cubin, log = compile_kernels(nvrtc, KernelOptions(8, True, True), architecture, "--ptxas-options=-v")
        counts = instructions(cubin)
        for name, told in re.findall(r"Compiling entry function '(\w+)'.*?\n(.*?Used .*?)\n", log, re.DOTALL):
            registers = re.search(r"Used (\d+) registers", told)
            shared, spilled = re.search(r"(\d+) bytes smem", told), re.search(r"(\d+) bytes spill stores", told)
            figures = [int(match[1]) if match else 0 for match in (registers, shared, spilled)]
            print(
                f"{architecture / 10:4.1f} {name:16} {counts[name]:6} instructions, {figures[0]:3} registers, "
                f"{figures[1]:6} bytes shared, {figures[2]} spilled"
            )


if __name__ == "__main__":
    main()
