"""In a Python with rclpy: messages (pickled dicts) through the node's own filling, then rclpy's serialiser."""

import importlib
import pickle
import sys
from pathlib import Path

from rclpy.serialization import serialize_message

from perception.node.ros import fill

given = pickle.loads(Path(sys.argv[1]).read_bytes())
made = {}
for kind, messages in given.items():
    package, space, name = kind.split("/")
    if package == "vision_msgs":  # not among the packages on PyPI
        continue
    holder = importlib.import_module(f"{package}.{space}")
    service, _, half = name.partition("_")
    message_class = getattr(getattr(holder, service), half) if half else getattr(holder, name)
    made[kind] = [serialize_message(fill(message_class(), message)) for message in messages]
Path(sys.argv[2]).write_bytes(pickle.dumps(made))
