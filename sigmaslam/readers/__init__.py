"""Readers of stereo sequences."""

from sigmaslam.readers.detect import open_sequence
from sigmaslam.readers.sequence import StereoFrame, StereoSequence

__all__ = ["StereoFrame", "StereoSequence", "open_sequence"]
