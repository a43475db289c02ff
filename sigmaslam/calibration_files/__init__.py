"""Calibrations of every form, read and written."""
