"""Instances from Gaussians with features: clustering, splitting, scoring, rendering of silhouettes."""
