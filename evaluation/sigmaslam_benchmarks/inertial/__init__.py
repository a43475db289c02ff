"""The inertial sensor: through dark stretches with and without it."""
