"""Readers of stereo sequences."""
