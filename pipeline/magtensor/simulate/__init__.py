"""Simulate a survey: the physics in the time domain, independent of every regressor the calibration fits."""
