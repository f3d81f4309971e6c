"""Asks a running query node over DDS, without ROS 2: python examples/ask_a_node.py "red mug" (extra: ros)

ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE choose the network, as for ROS 2.
"""

import json
import sys
import time
import uuid

from perception.io.cdr import deserialize, serialize
from perception.node.channels import ANSWER, PROMPT
from perception.node.config import NodeConfig
from perception.node.participant import Participant

config = NodeConfig(namespace=sys.argv[2] if len(sys.argv) > 2 else "perception")
participant = Participant(config.domain_id)
answers = participant.reader(f"rt/{ANSWER.path(config.namespace)}", ANSWER.kind)
prompts = participant.writer(f"rt/{PROMPT.path(config.namespace)}", PROMPT.kind)
mine = uuid.uuid4().hex
question = serialize(PROMPT.kind, {"data": json.dumps({"text": sys.argv[1], "id": mine})})

received: list[dict] = []
for _ in range(20):  # a message sent before node and client have discovered each other is lost: asked again
    prompts.write(question)
    time.sleep(0.5)
    told = [json.loads(deserialize(ANSWER.kind, data)["data"]) for data, _header in answers.take()]
    received = [answer for answer in told if answer["id"] == mine]
    if received:
        print(json.dumps(received[0], indent=1))
        break
participant.close()
sys.exit(0 if received else f"no node serves '{config.namespace}' on domain {config.domain_id}")
