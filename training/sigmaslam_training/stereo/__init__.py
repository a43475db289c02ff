"""Training of the stereo network on pairs of our own making."""
