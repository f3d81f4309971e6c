"""Reading and writing of bytes: arrays, clouds, PLY, JSON and YAML, atomic files."""
