"""Cameras calibrated from pictures of a board: corners, lens parameters with their uncertainty, and refusals."""

from perception.calibration.board import Board
from perception.calibration.calibrate import run_calibration

__all__ = ["Board", "run_calibration"]
