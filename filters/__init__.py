"""Batched Bayesian filters and inference in torch: see docs/filters.md."""

from sigmaslam.filters.bayes import BayesFilter, ExtendedKalmanFilter, KalmanFilter, UnscentedKalmanFilter
from sigmaslam.filters.belief import degree_of_belief
from sigmaslam.filters.compiled import compile_step
from sigmaslam.filters.failure import FilterError
from sigmaslam.filters.gaussian_belief import Gaussian
from sigmaslam.filters.inference import Observation, PointEstimate, maximum_a_posteriori, maximum_likelihood
from sigmaslam.filters.layout import stack
from sigmaslam.filters.lie_groups import wrap_angle
from sigmaslam.filters.manifolds import SE2, SE3, SO2, SO3, Euclidean, Manifold, Product
from sigmaslam.filters.models import LinearMeasurement, LinearMotion, MeasurementModel, MotionModel
from sigmaslam.filters.noise_covariance import BlockDiagonal, Dense, Diagonal
from sigmaslam.filters.onnx.step import ExportError, StepExample, export_step
from sigmaslam.filters.results import TimeUpdate, Update
from sigmaslam.filters.sigma_points import Simplex, cubature, julier, merwe
from sigmaslam.filters.time_series import Track

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
    "ExportError",
    "ExtendedKalmanFilter",
    "FilterError",
    "Gaussian",
    "KalmanFilter",
    "LinearMeasurement",
    "LinearMotion",
    "Manifold",
    "MeasurementModel",
    "MotionModel",
    "Observation",
    "PointEstimate",
    "Product",
    "Simplex",
    "StepExample",
    "TimeUpdate",
    "Track",
    "UnscentedKalmanFilter",
    "Update",
    "compile_step",
    "cubature",
    "degree_of_belief",
    "export_step",
    "julier",
    "maximum_a_posteriori",
    "maximum_likelihood",
    "merwe",
    "stack",
    "wrap_angle",
]
