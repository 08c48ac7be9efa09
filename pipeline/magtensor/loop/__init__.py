"""Closing the loop: what a calibration leaves over, and the effects that explain it."""
