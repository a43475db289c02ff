"""Readers of stereo sequences."""

from sigmaslam.readers.camera import open_cameras
from sigmaslam.readers.detect import open_sequence
from sigmaslam.readers.sequence import StereoFrame, StereoSequence

__all__ = ["StereoFrame", "StereoSequence", "open_cameras", "open_sequence"]
