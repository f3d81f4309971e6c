"""`python rclpy_asker.py NAMESPACE TEXT…`: asks the node's service the texts in turn, each until it is answered.

Runs until it is killed. Prints a line an answer: the text, a tab, the answer's JSON.
"""

import itertools
import sys

import rclpy
from rcl_interfaces.srv import GetParameters

RETRY = 0.5

rclpy.init()
node = rclpy.create_node("asker")
query = node.create_client(GetParameters, f"/{sys.argv[1]}/query")
for text in itertools.cycle(sys.argv[2:]):
    answered = None
    while answered is None:
        asked = query.call_async(GetParameters.Request(names=[text]))
        rclpy.spin_until_future_complete(node, asked, timeout_sec=RETRY)
        if asked.done():
            answered = asked.result().values[0].string_value
        else:
            query.remove_pending_request(asked)
    print(text, answered, sep="\t", flush=True)
