"""Faults of live cameras, simulated: what drivers do to good frames, and whether the tracker says so."""
