"""Relative poses of two views from their matches alone."""
