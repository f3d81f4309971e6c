"""Camera calibration from photos of a board: corner detection, lens parameters with uncertainty, acceptance checks."""

from perception.calibration.board import Board
from perception.calibration.calibrate import run_calibration

__all__ = ["Board", "run_calibration"]
