"""Rigid bodies that a camera at rest follows."""
