"""From Gaussians with features to instances: cluster, tell apart, score, see."""
