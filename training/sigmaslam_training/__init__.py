"""Training of the networks on synthetic images only."""
