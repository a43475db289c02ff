"""Offline bundle adjustment of a run: the reference that the filter is compared with."""

from sigmaslam.bundle_adjustment.adjustment import Adjustment, RefineConfig, adjust
from sigmaslam.bundle_adjustment.refine_run import refine_run
from sigmaslam.bundle_adjustment.track_file import Tracks, read_tracks

__all__ = ["Adjustment", "RefineConfig", "Tracks", "adjust", "read_tracks", "refine_run"]
