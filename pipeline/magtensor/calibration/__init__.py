"""The mathematics of sensor calibration: plain numpy with documented shapes; knows nothing of recipes."""
