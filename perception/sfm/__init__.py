"""Structure from motion: poses and a sparse cloud."""
