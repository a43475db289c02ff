"""Front-ends: images in, correspondences out."""

from sigmaslam.frontend.build import FRONTENDS, build_frontend
from sigmaslam.frontend.types import Features, Frontend, KeypointSearch, StereoView, TemporalMatches

__all__ = ["FRONTENDS", "Features", "Frontend", "KeypointSearch", "StereoView", "TemporalMatches", "build_frontend"]
