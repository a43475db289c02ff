"""Training of the correspondence network."""
