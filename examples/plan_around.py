"""What lies near a pose, and what blocks a corridor: python examples/plan_around.py kitchen.gsmap"""

import sys

import numpy as np

import perception
from perception.query import axis_box

gmap = perception.load_map(sys.argv[1])
robot = np.zeros(3)  # in the map's frame

for hit in gmap.nearest(robot, top_k=3):
    print(f"instance {hit.instance_id} is {hit.distance:.2f} away, its box measures {np.round(hit.obb.extent, 2)}")

corridor = axis_box([0.2, -0.4, -1.0], [2.0, 0.4, 1.0])
blocking = gmap.in_box(corridor, share=0.05)  # at least 5 % of its points
print("the corridor is", "blocked by " + ", ".join(str(hit.instance_id) for hit in blocking) if blocking else "free")
