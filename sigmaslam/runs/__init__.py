"""Tracking whole recordings into run folders, with a report."""
