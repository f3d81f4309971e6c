"""Gaussians: rasterization, losses, densification, training."""
