"""Localisation of wheeled robots and stereo cameras among known landmarks: see docs/localisation.md."""
