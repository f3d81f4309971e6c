"""The frame of a map: its unit from things of known size, its vertical from gravity, with their standard errors."""
