"""`python rclpy_client.py NAMESPACE OUT.npz TEXT…`: what an rclpy client hears from a node. Only ROS's own types."""

import json
import sys
import time
from collections import defaultdict

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import GetParameters
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

space, out, texts = sys.argv[1], sys.argv[2], sys.argv[3:]
WAIT = 25.0


def columns(cloud):
    kinds = {5: "<i4", 6: "<u4", 7: "<f4"}
    layout = {
        "names": [f.name for f in cloud.fields],
        "formats": [kinds[f.datatype] for f in cloud.fields],
        "offsets": [f.offset for f in cloud.fields],
        "itemsize": cloud.point_step,
    }
    return np.frombuffer(cloud.data.tobytes(), np.dtype(layout))


def xyz(cloud):
    rows = columns(cloud)
    return np.stack([rows[axis] for axis in "xyz"], axis=1)


def spin_until(done):
    limit = time.monotonic() + WAIT
    while not done():
        if time.monotonic() > limit:
            sys.exit(f"waited {WAIT} s in vain; heard { {k: len(v) for k, v in heard.items()} }")
        rclpy.spin_once(node, timeout_sec=0.05)


rclpy.init()
node = rclpy.create_node("asker")
heard = defaultdict(list)
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
for topic, kind, quality in (
    ("answer", String, 10),
    ("answer/points", PointCloud2, 10),
    ("answer/markers", MarkerArray, 10),
    ("map/points", PointCloud2, latched),
):
    node.create_subscription(kind, f"/{space}/{topic}", heard[topic].append, quality)
node.create_subscription(DiagnosticArray, "/diagnostics", heard["health"].append, 10)
prompts = node.create_publisher(String, f"/{space}/prompt", 10)
spin_until(lambda: heard["map/points"] and heard["health"] and prompts.get_subscription_count())
found = {"map": xyz(heard["map/points"][0]), "health": heard["health"][-1].status[0].message}

for text in texts:
    for topic in ("answer", "answer/points", "answer/markers"):
        heard[topic].clear()
    prompts.publish(String(data=text))
    spin_until(lambda: all(heard[topic] for topic in ("answer", "answer/points", "answer/markers")))
    cloud = heard["answer/points"][0]
    rows = columns(cloud)
    found[f"{text}/json"] = heard["answer"][0].data
    found[f"{text}/points"] = xyz(cloud)
    found[f"{text}/stamp"] = np.array([cloud.header.stamp.sec, cloud.header.stamp.nanosec])
    found[f"{text}/instance_id"], found[f"{text}/score"] = rows["instance_id"], rows["score"]
    marks = [m for m in heard["answer/markers"][0].markers if m.action == 0]
    found[f"{text}/markers"] = np.array(
        [[m.pose.position.x, m.pose.orientation.w, m.scale.x, m.color.g, m.type, m.id] for m in marks]
    )

query = node.create_client(GetParameters, f"/{space}/query")
reload = node.create_client(Trigger, f"/{space}/reload")
spin_until(lambda: query.service_is_ready() and reload.service_is_ready())
for text in texts:
    asked = query.call_async(GetParameters.Request(names=[text, json.dumps({"text": text, "want": "points"}), ""]))
    spin_until(asked.done)
    told = asked.result().values
    found[f"{text}/service"] = told[0].string_value
    found[f"{text}/service points"] = np.array(told[1].double_array_value)
    found["empty/service"] = told[2].string_value
asked = reload.call_async(Trigger.Request())
spin_until(asked.done)
found["reload"] = asked.result().message
np.savez(out, **found)
node.destroy_node()
rclpy.shutdown()
