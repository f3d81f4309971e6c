"""Extracts photos, intrinsics and poses from ROS bags (ROS 1, ROS 2, MCAP), as input for mapping."""
