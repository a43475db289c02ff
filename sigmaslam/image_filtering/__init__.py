"""Bayesian filters of images: of one from its own patches, of a sequence pixel by pixel over time."""

from sigmaslam.image_filtering.noise import NoiseModel, estimate_noise
from sigmaslam.image_filtering.sequence_filter import SequenceFilter, filter_both_ways
from sigmaslam.image_filtering.single_image import denoise_image

__all__ = ["NoiseModel", "SequenceFilter", "denoise_image", "estimate_noise", "filter_both_ways"]
