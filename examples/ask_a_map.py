"""Where is it? python examples/ask_a_map.py kitchen.gsmap "red mug" "laptop" """

import sys

import perception

gmap = perception.load_map(sys.argv[1])
for text in sys.argv[2:]:
    hits = gmap.query(text, top_k=3)
    if not hits:
        print(f"{text}: not present")
    for hit in hits:
        x, y, z = hit.centroid
        print(f"{text}: instance {hit.instance_id}, score {hit.score:.2f}, at ({x:.2f}, {y:.2f}, {z:.2f})")
