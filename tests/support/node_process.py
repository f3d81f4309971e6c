"""`python node_process.py MAP KEY=VALUE…`: a node with the tests' encoder, in a process of its own."""

import sys
from pathlib import Path

from perception.config import read_pairs
from perception.errors import InputError
from perception.node.config import node_config
from perception.node.ros import serve_node, stop_on_signals
from support.node_maps import encoders

if __name__ == "__main__":
    try:
        with stop_on_signals() as stop:
            serve_node(
                Path(sys.argv[1]),
                node_config(read_pairs(sys.argv[2:])),
                stop,
                lambda text: print(text, flush=True),
                encoders,
            )
    except InputError as error:
        sys.exit(f"error: {error}")
