"""Asks a running query node through ROS 2: python examples/ask_a_node.py "red mug" [NAMESPACE]"""

import json
import sys
import time
import uuid

import rclpy
from std_msgs.msg import String

namespace = sys.argv[2] if len(sys.argv) > 2 else "perception"
mine = uuid.uuid4().hex
question = String(data=json.dumps({"text": sys.argv[1], "id": mine}))
received: list[dict] = []


def hear(message: String) -> None:
    """Keeps the answer to our own question; other clients' answers come on the same topic."""
    answer = json.loads(message.data)
    if answer["id"] == mine:
        received.append(answer)


rclpy.init()
node = rclpy.create_node("asker")
prompts = node.create_publisher(String, f"/{namespace}/prompt", 10)
node.create_subscription(String, f"/{namespace}/answer", hear, 10)
end, again = time.monotonic() + 10, 0.0
while not received and time.monotonic() < end:
    if time.monotonic() >= again:  # a message sent before node and client have discovered each other is lost
        prompts.publish(question)
        again = time.monotonic() + 0.5
    rclpy.spin_once(node, timeout_sec=0.1)
node.destroy_node()
rclpy.shutdown()
print(json.dumps(received[0], indent=1) if received else f"no node serves '{namespace}'")
sys.exit(0 if received else 1)
