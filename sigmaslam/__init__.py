"""Stereo visual SLAM whose covariance can be believed."""

from sigmaslam.camera import StereoCamera
from sigmaslam.config import TrackerConfig
from sigmaslam.errors import SigmaSlamError
from sigmaslam.estimate import Estimate
from sigmaslam.match import Matches, match_images
from sigmaslam.readers import open_sequence
from sigmaslam.tracker import StereoTracker

__all__ = [
    "Estimate",
    "Matches",
    "SigmaSlamError",
    "StereoCamera",
    "StereoTracker",
    "TrackerConfig",
    "match_images",
    "open_sequence",
]
