"""Readers of stereo sequences."""

from sigmaslam.calibration_files.calibration import read_calibration
from sigmaslam.readers.live import open_cameras
from sigmaslam.readers.open import open_sequence
from sigmaslam.readers.stereo_sequence import StereoFrame, StereoSequence

__all__ = ["StereoFrame", "StereoSequence", "open_cameras", "open_sequence", "read_calibration"]
