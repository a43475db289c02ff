"""Measures of trajectories, of probabilities and covariances, and of maps."""
