"""Training of detector and descriptors together, on one GPU."""
