"""The calibration with effects in it: records, the joint fit, and its errors before and after."""
