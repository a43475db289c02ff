"""Monte-Carlo scenarios for filters: simulated runs, all at once, and what a filter makes of them."""

from sigmaslam_benchmarks.filters.scenarios.classics import bearings, coordinated_turn, growth, reentry
from sigmaslam_benchmarks.filters.scenarios.poses import CAMERA, localisation, stereo_pose, vague_prior
from sigmaslam_benchmarks.filters.scenarios.scenario import Outcome, Scenario, run

__all__ = [
    "CAMERA",
    "Outcome",
    "Scenario",
    "bearings",
    "coordinated_turn",
    "growth",
    "localisation",
    "reentry",
    "run",
    "stereo_pose",
    "vague_prior",
]
