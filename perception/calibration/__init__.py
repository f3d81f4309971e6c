"""Camera calibration from photos of a board: corner detection, lens parameters with uncertainty, acceptance checks."""
