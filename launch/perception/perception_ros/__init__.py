"""The lifecycle node of a map on ROS 2: a shell around `perception.node` that converts messages."""
