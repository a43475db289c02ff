"""Kalman, extended and unscented filters: one Bayes filter (9.21) that differs in how a Gaussian meets a function."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from sigmaslam_filters.checks import (
    check_belief,
    check_entering,
    check_inputs,
    check_model,
    check_motion,
    check_space,
    check_update,
)
from sigmaslam_filters.core.columns import Columns, noise_entering, predicted_covariance, predicted_factor
from sigmaslam_filters.core.factors import both, finite, may_look, multiply, nonnegative, square, triangularise
from sigmaslam_filters.core.failure import POLICIES, OnFailure, Suspects, jittered, raise_unless_healthy
from sigmaslam_filters.core.noise_covariance import Noise, as_noise
from sigmaslam_filters.core.plain_factors import PIVOT_TOLERANCES
from sigmaslam_filters.core.sigma_points import SigmaPoints, cubature
from sigmaslam_filters.core.solve import FORMS, Form, TangentPosterior, choose_form
from sigmaslam_filters.core.transforms import Exact, Taylor, Transform, Unscented
from sigmaslam_filters.gaussian_belief import Gaussian
from sigmaslam_filters.linearisation import Linearisation, LinearisedMeasurement
from sigmaslam_filters.manifolds import Space
from sigmaslam_filters.models import (
    MEASUREMENTS,
    MOTIONS,
    AnyMeasurement,
    AnyMotion,
    LinearMeasurement,
    LinearMotion,
    is_additive,
)
from sigmaslam_filters.results import TimeUpdate, Update
from sigmaslam_filters.robust import Robust
from sigmaslam_filters.sight import Sight
from sigmaslam_filters.time_series import SequenceFilter

# Squared linearisation error of a whole measurement, in units of its noise's variance, from which on an update is worth
# a second linearisation.
TOLERATED_ERROR = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class BayesFilter(SequenceFilter):
    """Predict and correct, for any number of filters at once.

    Made by `KalmanFilter`, `ExtendedKalmanFilter` and `UnscentedKalmanFilter`.

    Attributes:
        transform: how a Gaussian goes through a function.
        space: manifold of the state; None: R^n.
        form: of the update, see `sigmaslam_filters.core.solve`; "auto" chooses by shapes and dtype. "qr" goes on with
            square roots, "dense" and "low-rank" with covariances.
        iterations: linearisations of an update, from the second on at the posterior of the one before (posterior
            linearisation, García-Fernández et al. 2015; with derivatives, the iterated EKF). "auto": a second one for
            elements whose sigma points show more linearisation error than `TOLERATED_ERROR`; the EKF sees none. A set
            that cannot show it, `Simplex`, always takes the second.
        on_failure: see `sigmaslam_filters.core.failure`.
    """

    transform: Transform
    space: Space | None = None
    form: Form | Literal["auto"] = "auto"
    iterations: int | Literal["auto"] = "auto"
    on_failure: OnFailure = "raise"
    linearisation: Linearisation = field(init=False, repr=False)

    def __post_init__(self) -> None:
        check_space(self.space)
        object.__setattr__(self, "linearisation", Linearisation(self.transform, self.space))
        if self.form != "auto" and self.form not in FORMS:
            raise ValueError(f"form is {self.form!r}; choose auto, {', '.join(FORMS)}")
        if self.on_failure not in POLICIES:
            raise ValueError(f"on_failure is {self.on_failure!r}; choose {', '.join(POLICIES)}")
        if self.iterations != "auto" and self.iterations < 1:
            raise ValueError(f"iterations is {self.iterations}; it must be 'auto' or at least 1")

    def predict(self, belief: Gaussian, motion: AnyMotion, *inputs: Tensor) -> TimeUpdate:
        """The belief after a motion: the "action" of (9.21); (9.22), Table 9.1 and steps 2 and 3 of Table 9.2.

        Args:
            belief: batch (...,).
            motion: see `MotionModel`; noise and matrices broadcast over the batch.
            inputs: passed on to the motion's function, each of batch shape (..., ·): controls, time steps.
        Raises:
            FilterError: an element's covariance is not positive semidefinite or not finite, and on_failure is "raise".
            ValueError: shapes do not fit.
        """
        check_model(motion, MOTIONS, "the motion")
        noise = as_noise(motion.noise, f"{type(motion).__name__}.noise")
        check_belief(belief, self.space)
        check_inputs(inputs)
        check_motion(motion, noise, belief)
        if isinstance(motion, LinearMotion) and not self.goes_on_with_roots(belief):
            return self._predict_linear(belief, motion, noise, inputs)
        root, usable, sound = self._root(belief)
        usable = both(usable, nonnegative(noise.variance()))
        moved = self.linearisation.motion(belief.mean, root, motion, noise, inputs)
        mean = moved.mean if moved.reference is None else moved.reference
        columns, entering, noise_matrix = moved.columns, None, None
        usable = both(usable, finite(mean, columns.odd))
        if usable is not None:
            columns = columns.where(usable)
        if is_additive(motion):
            check_entering(motion, noise, columns.odd.shape[-2])
            entering, noise_matrix = noise, motion.noise_matrix
        else:
            columns = columns.without_noise(root.shape[-1])
        if self.goes_on_with_roots(belief):
            factor = predicted_factor(columns, entering, noise_matrix)
            predicted = Gaussian(mean, factor=factor, factor_is_lower=True)
        else:
            predicted = Gaussian(mean, predicted_covariance(columns, entering, noise_matrix), is_symmetric=True)
        usable = both(both(finite(mean, predicted.held), usable), _sound_variances(predicted))
        predicted = self._deal_with(usable, predicted, belief, "predict", _suspects(noise, predicted))
        return TimeUpdate(predicted, both(usable, sound), usable, lambda: (root, columns), entering, noise_matrix)

    def _predict_linear(
        self, belief: Gaussian, motion: LinearMotion, noise: Noise, inputs: tuple[Tensor, ...]
    ) -> TimeUpdate:
        """A P A^T + B2 Q B2^T, (9.22): no root is needed, so a covariance is not checked for being semidefinite."""
        self.linearisation.require_flat("LinearMotion")
        mean = motion.function(belief.mean, *inputs)
        covariance = multiply(multiply(motion.matrix, belief.covariance), motion.matrix.mT)
        covariance = covariance + noise_entering(noise, motion.noise_matrix)
        predicted = Gaussian(mean, covariance, is_symmetric=True)
        healthy = both(finite(mean, predicted.held), nonnegative(noise.variance()))
        healthy = both(healthy, _sound_variances(predicted))
        predicted = self._deal_with(healthy, predicted, belief, "predict", _suspects(noise, predicted))

        def joint() -> tuple[Tensor, Columns]:
            root = belief.factor
            return root, Columns(multiply(motion.matrix, root))

        return TimeUpdate(predicted, healthy, healthy, joint, noise, motion.noise_matrix)

    def update(
        self,
        belief: Gaussian,
        measurement: AnyMeasurement,
        value: Tensor,
        *inputs: Tensor,
        gate: float | None = None,
        robust: Robust | None = None,
    ) -> Update:
        """The belief after a measurement: the "perception" of (9.21); Table 9.1 and steps 4 to 7 of Table 9.2.

        Args:
            belief: batch (...,).
            measurement: see `MeasurementModel`; noise and matrices broadcast over the batch.
            value: (..., m) what was measured; NaN for a component that is missing.
            inputs: passed on to the measurement's function, each of batch shape (..., ·): landmarks, calibration.
            gate: probability that a block of a right measurement is inside the gate, such as 0.999; None: no gate.
            robust: "student_t" or "huber", noise with heavy tails; None: Gaussian. Blocks are the model's, see
                `MeasurementModel` and `sigmaslam_filters.robust`.
        Raises:
            FilterError: an element's covariance or innovation covariance is not positive semidefinite or not finite,
                and on_failure is "raise".
            ValueError: shapes do not fit.
        """
        sight, sound, belief = self._sight(belief, measurement, value, inputs)
        seen = sight.look()
        sight, seen = sight.gated(seen, gate, robust)
        form = self._form(belief, seen.columns, seen.innovation.shape[-1], sight.added is not None)
        at_prior = sight.solve(form, seen)
        solution, usable = self._relinearised(form, seen, sight, at_prior.solution)
        posterior = self._correct(belief, solution)
        usable = both(both(finite(posterior.mean, posterior.held), solution.healthy), usable)
        usable = both(usable, _sound_variances(posterior))
        suspects: dict[str, Callable[[], Tensor]] = {
            "measured value": lambda: torch.diag_embed(torch.where(value.isinf(), value, 1.0)),
            "measurement noise": sight.noise.covariance,
        }
        if (factored := solution.matrix) is not None:
            suspects["innovation covariance"] = lambda: factored
        posterior = self._deal_with(usable, posterior, belief, "update", suspects)
        count = sight.count if usable is None else torch.where(usable, sight.count, 0)
        healthy = both(usable, sound)
        return Update(posterior, seen.innovation, form, count, healthy, usable, at_prior, seen.columns, sight.root)

    def _sight(
        self, belief: Gaussian, measurement: AnyMeasurement, value: Tensor, inputs: tuple[Tensor, ...]
    ) -> tuple[Sight, Tensor | None, Gaussian]:
        """What an update looks at, whether its belief needed no mending (...,), and the belief in the value's batch."""
        check_model(measurement, MEASUREMENTS, "the measurement")
        noise = as_noise(measurement.noise, f"{type(measurement).__name__}.noise")
        batch = check_update(belief, self.space, measurement, noise, value, inputs)
        if belief.batch_shape != batch:
            belief = belief.expand(batch)
        root, usable, sound = self._root(belief)
        value, mask, count, measured = _without_missing(value, measurement.mask)
        usable = both(usable, measured)
        if mask is not None and is_additive(measurement):
            noise = noise.masked(mask)
        usable = both(usable, nonnegative(noise.variance()))
        sight = Sight(self.linearisation, measurement, inputs, value, belief.mean, root, noise, mask, count, usable)
        return sight, sound, belief

    def _relinearised(
        self, form: Form, seen: LinearisedMeasurement, sight: Sight, solution: TangentPosterior
    ) -> tuple[TangentPosterior, Tensor | None]:
        """The solution of the last linearisation that is asked for, and whether it is usable (...,)."""
        usable = seen.usable
        if self.iterations != "auto":
            for _ in range(0 if isinstance(sight.measurement, LinearMeasurement) else self.iterations - 1):
                last = sight.look(solution)
                solution = sight.solve(form, last).solution
                usable = both(usable, last.usable)
        elif seen.error is not None:
            bent = seen.error(sight.mask, sight.noise) > TOLERATED_ERROR
            if not may_look(bent) or bool(bent.any()):
                last = sight.look(solution)
                solution = sight.solve(form, last).solution.where(bent, solution)
                usable = both(usable, None if last.usable is None else last.usable | ~bent)
        return solution, usable

    def goes_on_with_roots(self, belief: Gaussian) -> bool:
        """Whether the belief after a step is held by a root."""
        if self.form != "auto":
            return self.form == "qr"
        return belief.is_square_root or torch.finfo(belief.mean.dtype).bits < 64

    def _form(self, belief: Gaussian, columns: Columns, measurements: int, additive: bool) -> Form:
        if self.form != "auto":
            return self.form
        return "qr" if self.goes_on_with_roots(belief) else choose_form(columns, measurements, additive)

    def _root(self, belief: Gaussian) -> tuple[Tensor, Tensor | None, Tensor | None]:
        """Lower root of the covariance (..., n, n); whether it is usable (...,), and whether it needed no mending."""
        root, usable = belief.checked_factor()
        sound = None
        if self.on_failure == "jitter" and usable is not None:
            sound = usable
            root, usable = jittered(belief.covariance, root, sound)
        if usable is not None:
            root = torch.where(usable[..., None, None], root, 0.0)
        return root, usable, sound

    def _correct(self, belief: Gaussian, solution: TangentPosterior) -> Gaussian:
        """The posterior of the state, with its covariance in the chart at the new mean."""
        mean = self.linearisation.retract(belief.mean, solution.shift)
        if self.linearisation.chart is None:
            if solution.root is not None:
                return Gaussian(mean, factor=solution.root, factor_is_lower=True)
            return Gaussian(mean, solution.covariance, is_symmetric=True)
        carried = self.linearisation.carry(belief.mean, solution.shift, solution.factor(), mean)
        if solution.root is not None:
            return Gaussian(mean, factor=triangularise(carried), factor_is_lower=True)
        return Gaussian(mean, square(carried), is_symmetric=True)

    def _deal_with(
        self, healthy: Tensor | None, result: Gaussian, before: Gaussian, stage: str, suspects: Suspects
    ) -> Gaussian:
        if healthy is None:
            return result
        if self.on_failure == "raise":
            prior: dict[str, Callable[[], Tensor]] = {
                "prior mean": lambda: torch.diag_embed(torch.where(before.mean.isfinite(), 1.0, before.mean)),
                "prior covariance": lambda: before.covariance,
            }
            raise_unless_healthy(healthy, stage, prior | dict(suspects))
            return result
        return result.where(healthy, before)


def KalmanFilter(  # noqa: N802 - three names for users, one class
    *, form: Form | Literal["auto"] = "auto", on_failure: OnFailure = "raise"
) -> BayesFilter:
    """For linear models, (9.22)-(9.25)."""
    return BayesFilter(Exact(), None, form, 1, on_failure)


def ExtendedKalmanFilter(  # noqa: N802
    space: Space | None = None,
    *,
    form: Form | Literal["auto"] = "auto",
    iterations: int | Literal["auto"] = "auto",
    on_failure: OnFailure = "raise",
) -> BayesFilter:
    """First derivatives at the mean, (9.26) and Table 9.1; attributes as `BayesFilter`."""
    return BayesFilter(Taylor(), space, form, iterations, on_failure)


def UnscentedKalmanFilter(  # noqa: N802
    space: Space | None = None,
    points: SigmaPoints | None = None,
    *,
    form: Form | Literal["auto"] = "auto",
    iterations: int | Literal["auto"] = "auto",
    on_failure: OnFailure = "raise",
) -> BayesFilter:
    """Sigma points, Table 9.2; `points` from `sigmaslam_filters.core.sigma_points`, by default `cubature()`."""
    if points is not None and not hasattr(points, "offsets"):
        raise TypeError(f"points is {points!r}: give a sigma set, such as cubature(), julier(kappa) or merwe(alpha)")
    return BayesFilter(Unscented(points or cubature()), space, form, iterations, on_failure)


def _suspects(noise: Noise, predicted: Gaussian) -> Suspects:
    """What may have made a prediction fail, beside the prior."""
    return {"process noise": noise.covariance, "predicted covariance": lambda: predicted.covariance}


def _sound_variances(belief: Gaussian) -> Tensor | None:
    """Whether no variance is negative beyond round-off, (...,) bool or None if so for all; a root has none."""
    if belief.is_square_root:
        return None
    variance = torch.diagonal(belief.held, dim1=-2, dim2=-1)
    return nonnegative(variance, PIVOT_TOLERANCES[variance.dtype])


def _without_missing(value: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor | None, Tensor | int, Tensor | None]:
    """Value with zeros for what is missing, mask (..., m) if anything can be, and the number of components.

    The last is whether what is there is finite, (...,) bool, or None if it is for all.
    """
    # Whether anything is missing is worth a look on a CPU; compiled or on a GPU the look costs more than the mask.
    regular = torch.isfinite(value)
    if mask is None and may_look(value) and bool(regular.all()):
        return value, None, value.shape[-1], None
    present = ~torch.isnan(value)
    present = present if mask is None else present & mask
    measured = (regular | ~present).all(dim=-1)
    return torch.where(present & regular, value, 0.0), present, present.sum(dim=-1), measured
