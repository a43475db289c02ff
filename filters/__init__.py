"""Batched Bayesian filters and inference in torch: see docs/filters.md."""

from sigmaslam.filters.adaptive import adapted_noise
from sigmaslam.filters.bayes import BayesFilter, ExtendedKalmanFilter, KalmanFilter, UnscentedKalmanFilter
from sigmaslam.filters.compiled_filter import compile_filter
from sigmaslam.filters.core.compiled import compile_step
from sigmaslam.filters.core.failure import FilterError
from sigmaslam.filters.core.layout import stack
from sigmaslam.filters.core.noise_covariance import BlockDiagonal, Dense, Diagonal
from sigmaslam.filters.core.sigma_points import Simplex, cubature, julier, merwe
from sigmaslam.filters.gaussian_belief import Gaussian, degree_of_belief
from sigmaslam.filters.graphs.step_export import ExportError, StepExample, export_step
from sigmaslam.filters.interacting import InteractingMultipleModels, Mixture
from sigmaslam.filters.learning import FittedNoise, fit_noise
from sigmaslam.filters.manifolds import SE2, SE3, SO2, SO3, Euclidean, Manifold, Product
from sigmaslam.filters.manifolds.lie_groups import wrap_angle
from sigmaslam.filters.models import LinearMeasurement, LinearMotion, MeasurementModel, MotionModel, several
from sigmaslam.filters.particles import ParticleFilter, Particles
from sigmaslam.filters.point_estimates import Observation, PointEstimate, maximum_a_posteriori, maximum_likelihood
from sigmaslam.filters.results import TimeUpdate, Update
from sigmaslam.filters.time_series import Event, Track

__all__ = [
    "SE2",
    "SE3",
    "SO2",
    "SO3",
    "BayesFilter",
    "BlockDiagonal",
    "Dense",
    "Diagonal",
    "Euclidean",
    "Event",
    "ExportError",
    "ExtendedKalmanFilter",
    "FilterError",
    "FittedNoise",
    "Gaussian",
    "InteractingMultipleModels",
    "KalmanFilter",
    "LinearMeasurement",
    "LinearMotion",
    "Manifold",
    "MeasurementModel",
    "Mixture",
    "MotionModel",
    "Observation",
    "ParticleFilter",
    "Particles",
    "PointEstimate",
    "Product",
    "Simplex",
    "StepExample",
    "TimeUpdate",
    "Track",
    "UnscentedKalmanFilter",
    "Update",
    "adapted_noise",
    "compile_filter",
    "compile_step",
    "cubature",
    "degree_of_belief",
    "export_step",
    "fit_noise",
    "julier",
    "maximum_a_posteriori",
    "maximum_likelihood",
    "merwe",
    "several",
    "stack",
    "wrap_angle",
]
