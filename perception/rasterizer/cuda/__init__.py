"""What runs on CUDA devices: the rasterizer's kernels (csrc/cuda), compiled at run time by NVRTC and launched, and the
losses and Adam. See docs/cuda.md.

No GPU has run it yet: the kernels are tested on the CPU, by an emulator of thread blocks.
"""
