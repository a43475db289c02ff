"""Poses, cameras, rectification and trajectories as arrays."""
