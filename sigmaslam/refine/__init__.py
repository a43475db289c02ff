"""Offline bundle adjustment of a run: the reference that the filter is compared with."""

from sigmaslam.refine.bundle import Adjustment, RefineConfig, adjust
from sigmaslam.refine.run import refine_run
from sigmaslam.refine.tracks import Tracks, read_tracks

__all__ = ["Adjustment", "RefineConfig", "Tracks", "adjust", "read_tracks", "refine_run"]
