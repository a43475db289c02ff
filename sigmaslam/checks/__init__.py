"""Checks of images, calibration and time stamps before they are trusted."""

from sigmaslam.checks.check import Check, check_pairs, check_sequence
from sigmaslam.checks.finding import Finding, explain, has_errors

__all__ = ["Check", "Finding", "check_pairs", "check_sequence", "explain", "has_errors"]
