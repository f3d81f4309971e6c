"""Mapper, node and viewer from one YAML file: `plan` reads and checks it, `run` starts the processes and watches."""
