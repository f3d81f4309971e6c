"""The query node: one process owns a map and serves it to robots, on DDS or through ROS 2's rclpy.

It only converts messages; `perception.query` does the thinking. `channels` lists the topics and services, `core` is
the node's logic, `dds` and `ros` carry its messages, `client` is a planner's side without ROS 2.
"""
