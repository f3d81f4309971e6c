"""Later visits to a mapped scene: what changed, and a map of today."""
