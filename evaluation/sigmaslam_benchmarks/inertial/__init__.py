"""The inertial sensor: through dark stretches with and without it, and faults of its table that are to be named."""
