"""The rasterizer: its tensors by name, and both passes on the CPU and on a device."""
