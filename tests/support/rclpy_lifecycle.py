"""`python rclpy_lifecycle.py NAMESPACE TEXT OUT.json`: walks a lifecycle node through its states and back, and asks in
each by both services. Writes [transition, state, kind of the answer by `query`, that by `find`] rows, then what the
latched topics, parameters and the RViz displays of the node were.
"""

import json
import sys
import time
from pathlib import Path

import rclpy
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import DescribeParameters, GetParameters
from rclpy.qos import DurabilityPolicy, QoSProfile
from visualization_msgs.msg import MarkerArray

try:
    from perception_msgs.msg import InstanceArray, MapInfo
    from perception_msgs.srv import Query
except ImportError:
    Query = None

space, text, out = sys.argv[1:4]
WALK = ("", "configure", "activate", "deactivate", "activate", "deactivate", "cleanup", "configure", "activate")
NUMBERS = {"configure": 1, "cleanup": 2, "activate": 3, "deactivate": 4, "shutdown": 7}  # from the active state
WAIT = 30.0

rclpy.init()
node = rclpy.create_node("walker")


def call(client, request):
    assert client.wait_for_service(WAIT), client.srv_name
    asked = client.call_async(request)
    rclpy.spin_until_future_complete(node, asked, timeout_sec=WAIT)
    assert asked.done(), f"{client.srv_name}: no answer"
    return asked.result()


change = node.create_client(ChangeState, f"/{space}/node/change_state")
state = node.create_client(GetState, f"/{space}/node/get_state")
query = node.create_client(GetParameters, f"/{space}/query")
find = Query and node.create_client(Query, f"/{space}/find")
heard = {}
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def latch(kind, name, read):
    node.create_subscription(
        kind, f"/{space}/{name}", lambda message: heard.setdefault(name, []).append(read(message)), latched
    )


latch(MarkerArray, "map/markers", lambda message: len(message.markers))
if Query:
    latch(MapInfo, "map/info", lambda message: [message.map_id, message.metric, message.header.frame_id])
    latch(InstanceArray, "map/instances", lambda message: [[one.id, one.label] for one in message.instances])


def kinds():
    told = json.loads(call(query, GetParameters.Request(names=[text])).values[0].string_value)
    row = [told["error"]["kind"] if "error" in told else [hit["instance_id"] for hit in told["hits"]]]
    if find:
        found = call(find, Query.Request(text=text))
        row.append(found.error or [one.id for one in found.answer.instances])
    return row


def step(transition):
    if transition:
        request = ChangeState.Request()
        request.transition.id = NUMBERS[transition]
        assert call(change, request).success, transition
    return [transition, call(state, GetState.Request()).current_state.label, *kinds()]


rows = [step(transition) for transition in WALK]
found = {"rows": rows}
if find:
    unknown = call(find, Query.Request(text=text, frame_id="moon"))
    found["unknown frame"] = [unknown.error, unknown.message]
end = time.monotonic() + WAIT
while len(heard.get("map/markers", [])) < 4 and time.monotonic() < end:  # active, active, cleaned up, active
    rclpy.spin_once(node, timeout_sec=0.1)
found["heard"] = {name: values[-1] for name, values in heard.items()}
describe = node.create_client(DescribeParameters, f"/{space}/node/describe_parameters")
told = call(describe, DescribeParameters.Request(names=["map", "workers", "timeout"])).descriptors
found["parameters"] = [
    [
        one.name,
        bool(one.description),
        [[r.from_value, r.to_value] for r in (*one.integer_range, *one.floating_point_range)],
    ]
    for one in told
]
found["topics"] = dict(node.get_topic_names_and_types())
found["rows"].append(step("shutdown"))
Path(out).write_text(json.dumps(found))
node.destroy_node()
rclpy.shutdown()
