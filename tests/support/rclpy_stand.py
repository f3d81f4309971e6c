"""`python rclpy_stand.py NAMESPACE OUT.json ID FRAME…`: where to stand beside an instance, by the node's service, in
each frame; "" is that of the node's messages. Then for a robot of radius -1 and for instance 99."""

import json
import sys
import time
from pathlib import Path

import rclpy
from perception_msgs.srv import WhereToStand

space, out, number, *frames = sys.argv[1:]
rclpy.init()
node = rclpy.create_node("driver")
client = node.create_client(WhereToStand, f"/{space}/where_to_stand")
assert client.wait_for_service(30)


def ask(**fields):
    asked = client.call_async(WhereToStand.Request(**fields))
    rclpy.spin_until_future_complete(node, asked, timeout_sec=30)
    told = asked.result()
    at, turn = told.pose.pose.position, told.pose.pose.orientation
    return {
        "error": told.error,
        "message": told.message,
        "frame": told.pose.header.frame_id,
        "position": [at.x, at.y, at.z],
        "orientation": [turn.x, turn.y, turn.z, turn.w],
        "distance": told.distance,
    }


end = time.monotonic() + 30
while ask(instance_id=int(number))["error"] == "closed" and time.monotonic() < end:  # it activates itself
    time.sleep(0.2)
found = [ask(instance_id=int(number), frame_id=frame, distance=0.75) for frame in frames]
found += [ask(instance_id=int(number), radius=-1.0), ask(instance_id=99)]
Path(out).write_text(json.dumps(found))
node.destroy_node()
rclpy.shutdown()
