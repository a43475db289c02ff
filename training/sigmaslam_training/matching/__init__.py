"""Training of the scorer and the verifier of matches."""
