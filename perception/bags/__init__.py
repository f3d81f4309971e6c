"""Photos, intrinsics and poses out of ROS bags (ROS 1, ROS 2, MCAP), for the mapper."""

from perception.bags.frames import FrameOptions, run_frames

__all__ = ["FrameOptions", "run_frames"]
