"""The rasterizer's kernels (csrc/cuda) compiled and launched, the losses and Adam on CUDA devices. See docs/cuda.md."""
