"""The rasterizer on CUDA devices: csrc/cuda/kernels.cu, compiled at run time by NVRTC. See docs/cuda.md.

No GPU has run it yet: the kernels are tested on the CPU, by an emulator of thread blocks.
"""
