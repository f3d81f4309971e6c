"""`python lifecycle_process.py --ros-args …`: the lifecycle node with the tests' encoder, in a process of its own."""

import sys

from perception_ros.node import main

from support.node_maps import encoders

if __name__ == "__main__":
    sys.exit(main(encoders=encoders))
