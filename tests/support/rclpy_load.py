"""`python rclpy_load.py COUNT EXPECTED.json NAMESPACE…`: asks each namespace's service COUNT prompts, 8 at a time, each
until it is answered, and compares every answer with EXPECTED[namespace]: the map's id, and a prompt's instances.

Prints the number of answers now and then, at the end a JSON object. Lost: a prompt without an answer at the end.
Crossed: an answer with another prompt's id or text, another map's id, or other instances.
"""

import json
import sys
import time
from collections import Counter
from pathlib import Path

import rclpy
from rcl_interfaces.srv import GetParameters

FLYING, SILENT, STUCK = (
    8,
    5.0,
    120.0,
)  # prompts at a time; seconds until one is asked again, and until the run is given up
count, spaces = int(sys.argv[1]), sys.argv[3:]
expected = json.loads(Path(sys.argv[2]).read_text())
rclpy.init()
node = rclpy.create_node("load")
clients = {space: node.create_client(GetParameters, f"/{space}/query") for space in spaces}
assert all(client.wait_for_service(30) for client in clients.values())
prompts = {space: list(expected[space]["instances"]) for space in spaces}
todo = {space: [(f"{space}-{n}", prompts[space][n % 3]) for n in reversed(range(count))] for space in spaces}
flying = {space: {} for space in spaces}
answers, seen = Counter(), Counter()
told, last = 0, time.monotonic()


def judge(space, identity, text, answer):
    """Counts one answer; True when the prompt is to be asked again."""
    if "error" in answer:
        seen["crossed"] += answer["id"] != identity
        seen[f"asked again, {answer['error']['kind']}"] += 1
        return True
    ids = [hit["instance_id"] for hit in answer["hits"]]
    right = (identity, text, expected[space]["map_id"], expected[space]["instances"][text])
    seen["crossed"] += (answer["id"], answer["text"], answer["map_id"], ids) != right
    seen["answered twice"] += identity in answers
    answers[identity] += 1
    return False


while any(todo.values()) or any(flying.values()):
    now = time.monotonic()
    if now - last > STUCK:
        break
    for space, client in clients.items():
        while todo[space] and len(flying[space]) < FLYING:
            identity, text = todo[space].pop()
            request = GetParameters.Request(names=[json.dumps({"text": text, "id": identity})])
            flying[space][identity] = (text, now, client.call_async(request))
        for identity, (text, since, future) in list(flying[space].items()):
            if future.done():
                last = now
                again = judge(space, identity, text, json.loads(future.result().values[0].string_value))
            elif now - since > SILENT:
                client.remove_pending_request(future)
                seen["asked again, silent"] += 1
                again = True
            else:
                continue
            del flying[space][identity]
            if again:
                todo[space].append((identity, text))
    rclpy.spin_once(node, timeout_sec=0.05)
    if len(answers) >= told + 100:
        told = len(answers)
        print(told, flush=True)
print(json.dumps({"asked": count * len(spaces), "lost": count * len(spaces) - len(answers), "crossed": 0, **seen}))
node.destroy_node()
rclpy.shutdown()
