"""What an error model is made of: the survey it sees, its regressors, its settings and what it needs."""
