"""The query node: one process that serves a map to robots through ROS 2's rclpy.

It only converts messages; `perception.query` answers the queries. `answers` lists the topics and services, `core` is
the node's logic, `ros` its transport.
"""
