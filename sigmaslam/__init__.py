"""Stereo visual SLAM whose covariance can be believed."""

from sigmaslam.camera import StereoCamera
from sigmaslam.errors import SigmaSlamError
from sigmaslam.readers import open_sequence
from sigmaslam.tracker import Estimate, StereoTracker, TrackerConfig

__all__ = ["Estimate", "SigmaSlamError", "StereoCamera", "StereoTracker", "TrackerConfig", "open_sequence"]
