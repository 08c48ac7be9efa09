"""A calibration with effects, stored and applied to this or another survey."""
