"""What the data say of regressors: the residual, the colour of its noise, significance, and gain on held-out blocks."""
