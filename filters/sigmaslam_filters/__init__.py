"""Batched Bayesian filters and inference in torch: see docs/filters.md."""

from sigmaslam_filters.adaptive import adapted_noise
from sigmaslam_filters.bayes import BayesFilter, ExtendedKalmanFilter, KalmanFilter, UnscentedKalmanFilter
from sigmaslam_filters.compiler import compile_filter, compile_step
from sigmaslam_filters.core.failure import FilterError
from sigmaslam_filters.core.layout import stack
from sigmaslam_filters.core.noise_covariance import BlockDiagonal, Dense, Diagonal
from sigmaslam_filters.core.sigma_points import Simplex, cubature, julier, merwe
from sigmaslam_filters.gaussian_belief import Gaussian, degree_of_belief
from sigmaslam_filters.graphs.step_export import ExportError, StepExample, export_step
from sigmaslam_filters.interacting import InteractingMultipleModels, Mixture
from sigmaslam_filters.learning import FittedNoise, fit_noise
from sigmaslam_filters.manifolds import SE2, SE3, SO2, SO3, Euclidean, Manifold, Product
from sigmaslam_filters.manifolds.lie_groups import wrap_angle
from sigmaslam_filters.models import LinearMeasurement, LinearMotion, MeasurementModel, MotionModel, several
from sigmaslam_filters.particles import EnsembleKalmanFilter, ParticleFilter, Particles
from sigmaslam_filters.point_estimates import Observation, PointEstimate, maximum_a_posteriori, maximum_likelihood
from sigmaslam_filters.results import TimeUpdate, Update
from sigmaslam_filters.time_series import Event, Track, interleaved

__all__ = ["SE2", "SE3", "SO2", "SO3", "BayesFilter", "BlockDiagonal", "Dense", "Diagonal", "EnsembleKalmanFilter"]
__all__ += ["Euclidean", "Event", "ExportError", "ExtendedKalmanFilter", "FilterError", "FittedNoise", "Gaussian"]
__all__ += ["InteractingMultipleModels", "KalmanFilter", "LinearMeasurement", "LinearMotion", "Manifold"]
__all__ += ["MeasurementModel", "Mixture", "MotionModel", "Observation", "ParticleFilter", "Particles"]
__all__ += ["PointEstimate", "Product", "Simplex", "StepExample", "TimeUpdate", "Track", "UnscentedKalmanFilter"]
__all__ += ["Update", "adapted_noise", "compile_filter", "compile_step", "cubature", "degree_of_belief"]
__all__ += ["export_step", "fit_noise", "interleaved", "julier", "maximum_a_posteriori", "maximum_likelihood"]
__all__ += ["merwe", "several", "stack", "wrap_angle"]
