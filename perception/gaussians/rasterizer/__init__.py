"""What `perception.gaussians.rasterize` is made of: its tensors by name, and both passes on the CPU and on a device."""
