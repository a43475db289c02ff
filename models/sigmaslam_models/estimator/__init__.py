"""The tracker's estimator: prediction, the update of a frame and the solution of a window, as torch modules."""
