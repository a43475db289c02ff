"""Other people's filters on the work of `filter_work`, each driven as its documentation has it.

Every maker builds the model and compiles outside, and returns a function without arguments that does one prediction and
one update from the prior of the work and hands back numpy arrays; only that function is to be timed. Libraries are
imported when they are asked for.

Bearings are given to the libraries relative to the measured one, with a measured value of zero: some have no place for
a wrapped difference, and where there is one it costs time. The reference wraps, and the results agree.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sigmaslam_benchmarks.filters.work import (
    BASELINE,
    FOCAL_LENGTH,
    PRINCIPAL_POINT,
    TIME_STEP,
    Array,
    LandmarkWork,
    LinearWork,
    LocalisationWork,
    PositionWork,
    StereoWork,
    Work,
    advance,
    drive,
    project_landmark,
    project_stereo,
    range_and_bearing,
    wrap,
)

Step: TypeAlias = Callable[[], tuple[NDArray[Any], NDArray[Any]]]
Model: TypeAlias = Callable[[Any, Any, Any], Any]

_BATCHED = (LocalisationWork, PositionWork, LandmarkWork)
_UNSCENTED = (StereoWork, *_BATCHED)


class Maker(Protocol):
    """Builds the step of one library."""

    def __call__(self, work: Any, dtype: str = ...) -> Step:
        """The step on `work`, of a kind that the library can do, computed in `dtype`."""


@dataclass(frozen=True, slots=True)
class Peer:
    """A library and what it can do here.

    Attributes:
        name: as it stands in the table.
        modules: what must be importable.
        works: the kinds of work that it can do.
        dtypes: the precisions that it can work in, "float64" or "float32".
        make: builds the step, called as make(work, dtype).
        batched: whether a batch is one call of the library; otherwise it is a Python loop over single filters.
    """

    name: str
    modules: tuple[str, ...]
    works: tuple[type, ...]
    dtypes: tuple[str, ...]
    make: Maker
    batched: bool


def available() -> list[Peer]:
    """The peers that are installed, in the order of `PEERS`."""
    return [peer for peer in PEERS if all(find_spec(module) is not None for module in peer.modules)]


def single_thread_environment() -> dict[str, str]:
    """Environment variables that keep BLAS, torch and XLA on one CPU thread.

    They are read when the libraries are loaded: start the benchmark's process with them, as in
    subprocess.run(command, env={**os.environ, **single_thread_environment()}).
    """
    blas = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
    return {
        **dict.fromkeys(blas, "1"),
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
        # The size of XLA's own thread pool, which the flags leave at the number of cores.
        "NPROC": "1",
    }


@dataclass(frozen=True, slots=True)
class _PeerProblem:
    """A work as models of the form model(xp, states (..., n), inputs), with the inputs of each filter.

    In a batch every array but the noises has a leading dimension B; a single filter has none.
    """

    batched: bool
    mean: Array
    covariance: Array
    process_noise: Array
    measurement: Array
    measurement_noise: Array
    transition: Model
    transition_inputs: Array
    measure: Model
    measure_inputs: Array

    @property
    def arrays(self) -> tuple[Array, Array, Array, Array, Array]:
        """Mean, covariance, measurement, and the inputs of transition and measurement."""
        return self.mean, self.covariance, self.measurement, self.transition_inputs, self.measure_inputs

    def filters(self) -> list[tuple[Array, Array, Array, Array, Array]]:
        """The arrays of each filter."""
        return list(zip(*self.arrays, strict=True)) if self.batched else [self.arrays]

    def collect(self, means: list[Array], covariances: list[Array]) -> tuple[Array, Array]:
        """Results of `filters`, in the shapes of the work."""
        return (np.stack(means), np.stack(covariances)) if self.batched else (means[0], covariances[0])


def _problem(work: Work) -> _PeerProblem:
    if isinstance(work, LinearWork):
        raise TypeError("LinearWork is for Kalman filters: no unscented filter here takes it")
    no_inputs = np.empty((len(work.mean), 0))
    measurement = work.measurement
    transition: Model = drive
    measure: Model = _position
    measure_inputs = no_inputs
    if isinstance(work, StereoWork):
        transition, transition_inputs = lambda xp, states, inputs: advance(states, inputs), work.transition
        measure, measure_inputs = project_stereo, work.points
    elif isinstance(work, LandmarkWork):
        transition, transition_inputs = lambda xp, states, inputs: states, no_inputs
        measure = _project_landmark
    else:
        transition_inputs = work.control
    if isinstance(work, LocalisationWork):
        measure, measure_inputs = _range_and_relative_bearing, np.column_stack([work.landmark, measurement[:, 1]])
        measurement = measurement * np.array([1.0, 0.0])
    return _PeerProblem(
        not isinstance(work, StereoWork),
        work.mean,
        work.covariance,
        work.process_noise,
        measurement,
        work.measurement_noise,
        transition,
        transition_inputs,
        measure,
        measure_inputs,
    )


def _position(xp: Any, states: Any, inputs: Any) -> Any:
    return states[..., :2]


def _project_landmark(xp: Any, states: Any, inputs: Any) -> Any:
    return project_landmark(xp, states)


def _range_and_relative_bearing(xp: Any, states: Any, inputs: Any) -> Any:
    """Range and the bearing minus the measured one; inputs (..., 3) are the landmark and the measured bearing."""
    measured = range_and_bearing(xp, states, inputs[..., :2])
    return xp.stack([measured[..., 0], wrap(measured[..., 1] - inputs[..., 2])], -1)


def filterpy(work: Work, dtype: str = "float64") -> Step:
    """filterpy's UnscentedKalmanFilter with Merwe's points, or its KalmanFilter for linear work.

    Version 2.0 draws new sigma points at the end of predict(), so its result is that of the reference. Its
    CubatureKalmanFilter measures with the propagated points, which lack the process noise, and is not used.
    """
    _check_dtype(dtype, "float64")
    if isinstance(work, LinearWork):
        return _filterpy_linear(work)
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    problem = _problem(work)
    state_size, measurement_size = work.mean.shape[-1], work.measurement.shape[-1]
    move, see = _one_point(problem.transition), _one_point(problem.measure)
    unscented = UnscentedKalmanFilter(
        state_size,
        measurement_size,
        dt=None,
        hx=lambda x, inputs: see(x, inputs),
        fx=lambda x, dt, inputs: move(x, inputs),
        points=MerweScaledSigmaPoints(state_size, alpha=1.0, beta=0.0, kappa=0.0),
    )
    unscented.Q, unscented.R = problem.process_noise, problem.measurement_noise
    filters = problem.filters()

    def step() -> tuple[Array, Array]:
        means, covariances = [], []
        for mean, covariance, measurement, transition_inputs, measure_inputs in filters:
            unscented.x, unscented.P = mean, covariance
            unscented.predict(inputs=transition_inputs)
            unscented.update(measurement, inputs=measure_inputs)
            means.append(unscented.x)
            covariances.append(unscented.P)
        return problem.collect(means, covariances)

    return step


def _filterpy_linear(work: LinearWork) -> Step:
    from filterpy.kalman import KalmanFilter

    kalman = KalmanFilter(dim_x=4, dim_z=2)
    kalman.F, kalman.H, kalman.Q, kalman.R = (
        work.transition,
        work.observation,
        work.process_noise,
        work.measurement_noise,
    )

    def step() -> tuple[Array, Array]:
        means, covariances = [], []
        for mean, covariance, measurement in zip(work.mean, work.covariance, work.measurement, strict=True):
            kalman.x, kalman.P = mean, covariance
            kalman.predict()
            kalman.update(measurement)
            means.append(kalman.x)
            covariances.append(kalman.P)
        return np.stack(means), np.stack(covariances)

    return step


def _one_point(model: Model) -> Callable[[Array, Array], Array]:
    """The model of one sigma point, as filterpy calls it.

    For a handful of numbers `math` is ten times quicker than numpy, and a user of filterpy would take it.
    """
    single: dict[Model, Callable[[Array, Array], Array]] = {
        drive: _drive_one,
        _range_and_relative_bearing: _range_and_relative_bearing_one,
        _project_landmark: _project_landmark_one,
    }
    return single.get(model, partial(model, np))


def _drive_one(state: Array, control: Array) -> Array:
    x, y, theta = state.tolist()
    speed, turn_rate = control.tolist()
    step = speed * TIME_STEP
    return np.array([x + step * math.cos(theta), y + step * math.sin(theta), theta + turn_rate * TIME_STEP])


def _range_and_relative_bearing_one(state: Array, inputs: Array) -> Array:
    x, y, theta = state.tolist()
    landmark_x, landmark_y, measured = inputs.tolist()
    dx, dy = landmark_x - x, landmark_y - y
    return np.array([math.hypot(dx, dy), wrap(math.atan2(dy, dx) - theta - measured)])


def _project_landmark_one(state: Array, inputs: Array) -> Array:
    x, y, z = state.tolist()
    scale = FOCAL_LENGTH / z
    return np.array([scale * x + PRINCIPAL_POINT[0], scale * y + PRINCIPAL_POINT[1], scale * BASELINE])


def stone_soup(work: Work, dtype: str = "float64") -> Step:
    """Stone Soup's UnscentedKalmanPredictor and Updater with models of our own, which see all sigma points at once.

    Its predict() and predict_measurement() remember their last 128 results by the identity of the state, so that every
    step gets a new GaussianState: with the same one, only the update would be timed.
    """
    _check_dtype(dtype, "float64")
    from stonesoup.base import Property
    from stonesoup.models.base import GaussianModel
    from stonesoup.models.measurement import MeasurementModel
    from stonesoup.models.transition import TransitionModel
    from stonesoup.predictor.kalman import UnscentedKalmanPredictor
    from stonesoup.types.array import CovarianceMatrix, StateVector, StateVectors
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import UnscentedKalmanUpdater

    problem = _problem(work)
    process_noise, measurement_noise = CovarianceMatrix(work.process_noise), CovarianceMatrix(work.measurement_noise)

    class Transition(GaussianModel, TransitionModel):
        inputs: Any = Property()

        @property
        def ndim_state(self) -> int:
            return len(process_noise)

        def function(self, state: Any, noise: Any = False, **_: Any) -> Any:
            return StateVectors(problem.transition(np, np.asarray(state.state_vector).T, self.inputs).T)

        def covar(self, **_: Any) -> Any:
            return process_noise

    class Measurement(GaussianModel, MeasurementModel):
        inputs: Any = Property()

        @property
        def ndim_meas(self) -> int:
            return len(measurement_noise)

        def function(self, state: Any, noise: Any = False, **_: Any) -> Any:
            return StateVectors(problem.measure(np, np.asarray(state.state_vector).T, self.inputs).T)

        def covar(self, **_: Any) -> Any:
            return measurement_noise

    cubature = {"alpha": 1.0, "beta": 0.0, "kappa": 0.0}
    filters = []
    for mean, covariance, measurement, transition_inputs, measure_inputs in problem.filters():
        sensor = Measurement(ndim_state=len(mean), mapping=(), inputs=measure_inputs)
        filters.append(
            (
                StateVector(mean),
                CovarianceMatrix(covariance),
                Detection(StateVector(measurement), measurement_model=sensor),
                UnscentedKalmanPredictor(Transition(inputs=transition_inputs), **cubature),
                UnscentedKalmanUpdater(None, **cubature),
            )
        )

    def step() -> tuple[Array, Array]:
        means, covariances = [], []
        for mean, covariance, detection, predictor, updater in filters:
            prediction = predictor.predict(GaussianState(mean, covariance))
            posterior = updater.update(SingleHypothesis(prediction, detection))
            means.append(np.asarray(posterior.mean)[:, 0])
            covariances.append(np.asarray(posterior.covar))
        return problem.collect(means, covariances)

    return step


def dynamax(work: Work, dtype: str = "float64") -> Step:
    """The two halves of dynamax's unscented filter, compiled by jax.jit, and by jax.vmap over a batch.

    Its public unscented_kalman_filter() takes a whole sequence and works in the order update, predict: one step from a
    prior in our order would be two of its steps. What it is made of, `_predict` and `_condition_on`, is called instead,
    in our order and without its scan; for a sequence of length one it computes the same (tested). The log-likelihood,
    not asked for, is dropped by the compiler.

    Its solver adds 1e-9 to the diagonal of S, which shows where the measurement noise is small.
    """
    _check_dtype(dtype, "float64", "float32")
    import jax
    import jax.numpy as jnp
    from dynamax.nonlinear_gaussian_ssm.inference_ukf import _compute_lambda, _compute_weights, _condition_on, _predict

    problem = _problem(work)
    size = work.mean.shape[-1]
    # A context and not the global switch, so that both precisions live in one process.
    with jax.enable_x64(dtype == "float64"):
        spread = _compute_lambda(1.0, 0.0, size)
        mean_weights, covariance_weights = _compute_weights(size, 1.0, 0.0, spread)
        process_noise = jnp.asarray(work.process_noise, dtype)
        measurement_noise = jnp.asarray(work.measurement_noise, dtype)

        def one(mean: Any, covariance: Any, measurement: Any, transition_inputs: Any, measure_inputs: Any) -> Any:
            weights = (spread, mean_weights, covariance_weights)
            # Inputs come through the closure: those of dynamax are copied for every sigma point.
            none = jnp.zeros(1, dtype)
            mean, covariance, _ = _predict(
                mean,
                covariance,
                lambda states, _: problem.transition(jnp, states, transition_inputs),
                process_noise,
                *weights,
                none,
            )
            _, mean, covariance = _condition_on(
                mean,
                covariance,
                lambda states, _: problem.measure(jnp, states, measure_inputs),
                measurement_noise,
                *weights,
                none,
                measurement,
            )
            return mean, covariance

        arguments = [jnp.asarray(array, dtype) for array in problem.arrays]
        # Compiled here, for a jitted function would look up the precision again when it is called.
        compiled = jax.jit(jax.vmap(one) if problem.batched else one).lower(*arguments).compile()

    def step() -> tuple[NDArray[Any], NDArray[Any]]:
        mean, covariance = compiled(*arguments)
        return np.asarray(mean), np.asarray(covariance)

    return step


def pypose(work: Work, dtype: str = "float64", repaired: bool = True) -> Step:
    """PyPose's UKF, batched, with kappa = 0, as it is or with its two faults repaired.

    As it is, it takes the rows of the lower Cholesky factor for offsets, and pairs the deviations of the propagated
    points with the measurements of the points drawn anew: its result is wrong by many sigmas. It is meant for batches,
    but its mean lacks the dimension of the points, so that only a single filter runs. The repair keeps its weights, its
    covariances by sums of outer products and its pseudo-inverse.

    In float32 the covariance of the stereo problem is noise, for P - K S K^T cancels: take float32 for batches only.
    """
    _check_dtype(dtype, "float64", "float32")
    import torch
    from pypose.module import NLS, UKF

    problem = _problem(work)
    real = getattr(torch, dtype)

    class System(NLS):
        def __init__(self, measure_inputs: torch.Tensor) -> None:
            super().__init__()
            self.measure_inputs = measure_inputs

        def state_transition(self, state: Any, input: Any, t: Any = None) -> Any:
            return problem.transition(torch, state, self._per_point(input, state))

        def observation(self, state: Any, input: Any, t: Any = None) -> Any:
            return problem.measure(torch, state, self._per_point(self.measure_inputs, state))

        def _per_point(self, inputs: Any, state: Any) -> Any:
            return inputs.unsqueeze(-2) if problem.batched and state.ndim > inputs.ndim else inputs

    class RepairedUKF(UKF):
        def forward(
            self, x: Any, y: Any, u: Any, P: Any, Q: Any = None, R: Any = None, t: Any = None, k: Any = None
        ) -> Any:
            points, weights = self.sigma_weight_points(x, P, k)
            points = self.model.state_transition(points, u)
            mean = (weights * points).sum(dim=-2)
            away = points - mean.unsqueeze(-2)
            P = self.compute_cov(away, away, weights, Q)

            points, weights = self.sigma_weight_points(mean, P, k)
            measured = self.model.observation(points, u)
            expected = (weights * measured).sum(dim=-2)
            away, off = points - mean.unsqueeze(-2), measured - expected.unsqueeze(-2)
            S = self.compute_cov(off, off, weights, R)
            gain = self.compute_cov(away, off, weights) @ torch.linalg.pinv(S)
            return mean + (gain @ (y - expected).unsqueeze(-1)).squeeze(-1), P - gain @ S @ gain.mT

    def columns(P: torch.Tensor) -> torch.Tensor:
        return torch.linalg.cholesky(P).mT

    system = System(torch.tensor(problem.measure_inputs, dtype=real))
    unscented = RepairedUKF(system, msqrt=columns) if repaired else UKF(system)
    mean, covariance, measurement, inputs, _, Q, R = (
        torch.tensor(array, dtype=real) for array in (*problem.arrays, problem.process_noise, problem.measurement_noise)
    )

    def step() -> tuple[NDArray[Any], NDArray[Any]]:
        with torch.inference_mode():
            posterior_mean, posterior_covariance = unscented(mean, measurement, inputs, covariance, Q, R, k=0)
        return posterior_mean.numpy(), posterior_covariance.numpy()

    return step


def torch_kf(work: LinearWork, dtype: str = "float64") -> Step:
    """torch-kf's KalmanFilter, batched, as its README has it."""
    _check_dtype(dtype, "float64", "float32")
    import torch
    from torch_kf import GaussianState, KalmanFilter

    def tensor(array: Array) -> torch.Tensor:
        return torch.tensor(array, dtype=getattr(torch, dtype))

    kalman = KalmanFilter(
        tensor(work.transition), tensor(work.observation), tensor(work.process_noise), tensor(work.measurement_noise)
    )
    prior = GaussianState(tensor(work.mean[..., None]), tensor(work.covariance))
    measurement = tensor(work.measurement[..., None])

    def step() -> tuple[NDArray[Any], NDArray[Any]]:
        with torch.inference_mode():
            posterior = kalman.update(kalman.predict(prior), measurement)
        return posterior.mean.squeeze(-1).numpy(), posterior.covariance.numpy()

    return step


def numpy_batched(work: Work, dtype: str = "float64") -> Step:
    """No library: the filter of `torch_linalg` in numpy, whose linear algebra takes stacks of matrices too."""
    _check_dtype(dtype, "float64")
    if isinstance(work, LinearWork):
        return _numpy_batched_linear(work)
    problem = _problem(work)
    return partial(_step_batch, np, problem, *problem.arrays, problem.process_noise, problem.measurement_noise)


def _step_batch(
    xp: Any,
    problem: _PeerProblem,
    mean: Any,
    covariance: Any,
    measurement: Any,
    transition_inputs: Any,
    measure_inputs: Any,
    Q: Any,
    R: Any,
) -> tuple[Any, Any]:
    """The batched filter that a person writes, batch first and without unrolling; xp is numpy or torch."""

    def sigma_points(mean: Any, covariance: Any) -> Any:
        offsets = math.sqrt(mean.shape[-1]) * xp.linalg.cholesky(covariance).mT
        return xp.concatenate([mean[..., None, :] + offsets, mean[..., None, :] - offsets], -2)

    points = problem.transition(xp, sigma_points(mean, covariance), transition_inputs[..., None, :])
    count = points.shape[-2]
    predicted = points.mean(-2)
    deviations = points - predicted[..., None, :]
    P = deviations.mT @ deviations / count + Q

    points = sigma_points(predicted, P)
    measured = problem.measure(xp, points, measure_inputs[..., None, :])
    expected = measured.mean(-2)
    X, Z = points - predicted[..., None, :], measured - expected[..., None, :]
    S = Z.mT @ Z / count + R
    # Quicker than torch.cholesky_solve, by five times for S of 2 x 2.
    gain = xp.linalg.solve(S, Z.mT @ X / count).mT
    posterior = predicted + (gain @ (measurement - expected)[..., None])[..., 0]
    return posterior, P - gain @ S @ gain.mT


def _numpy_batched_linear(work: LinearWork) -> Step:
    """The Kalman filter's textbook equations on stacks."""
    A, H = work.transition, work.observation

    def step() -> tuple[Array, Array]:
        predicted = work.mean @ A.T
        P = A @ work.covariance @ A.T + work.process_noise
        cross = H @ P
        S = cross @ H.T + work.measurement_noise
        gain = np.linalg.solve(S, cross).mT
        innovation = work.measurement - predicted @ H.T
        return predicted + (gain @ innovation[..., None])[..., 0], P - gain @ cross

    return step


def torch_linalg(work: Work, dtype: str = "float64") -> Step:
    """No library: the batched filter that a person writes with torch.linalg, batch first and without unrolling."""
    _check_dtype(dtype, "float64", "float32")
    import torch

    problem = _problem(work)
    tensors = [
        torch.tensor(array, dtype=getattr(torch, dtype))
        for array in (*problem.arrays, problem.process_noise, problem.measurement_noise)
    ]

    def step() -> tuple[NDArray[Any], NDArray[Any]]:
        with torch.inference_mode():
            posterior_mean, posterior_covariance = _step_batch(torch, problem, *tensors)
        return posterior_mean.numpy(), posterior_covariance.numpy()

    return step


def _check_dtype(dtype: str, *supported: str) -> None:
    if dtype not in supported:
        raise ValueError(f"dtype {dtype!r} is not one of {', '.join(supported)}")


_DOUBLE = ("float64",)
_BOTH = ("float64", "float32")

PEERS = (
    Peer("filterpy", ("filterpy",), (*_UNSCENTED, LinearWork), _DOUBLE, filterpy, batched=False),
    Peer("Stone Soup", ("stonesoup",), _UNSCENTED, _DOUBLE, stone_soup, batched=False),
    Peer("dynamax", ("dynamax", "jax"), _UNSCENTED, _BOTH, dynamax, batched=True),
    Peer("PyPose, repaired", ("pypose", "torch"), _UNSCENTED, _BOTH, pypose, batched=True),
    Peer("numpy batched", ("numpy",), (*_BATCHED, LinearWork), _DOUBLE, numpy_batched, batched=True),
    Peer("torch.linalg batched", ("torch",), _BATCHED, _BOTH, torch_linalg, batched=True),
    Peer("torch-kf", ("torch_kf", "torch"), (LinearWork,), _BOTH, torch_kf, batched=True),
)
