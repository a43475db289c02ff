"""Calibration of one camera or a stereo pair from images of a board."""
