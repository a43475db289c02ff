"""What is wrong with a pair, weighed by evidence: hypotheses about the calibration on the matches of the window.

Beside the window, which considers most errors of the calibration, stands the same window with all of them estimated:
the same views, linearised at the same place. Its errors have the prior N(0, S) of usual calibrations and the posterior
N(m, P), so the views say exp(-x^T L x / 2 + y^T x) of them, L = P^-1 - S^-1 and y = P^-1 m. A hypothesis adds an error
of standard deviation s in the direction w. As all is linear and Gaussian, its marginal likelihood over that of "nothing
is wrong" is a ratio of Savage and Dickey in closed form (Dickey 1971; Bishop 2006, section 3.5): with

    b = w^T S^-1 m,   a = w^T S^-1 (S - P) S^-1 w,   log ratio = (s^2 b^2 / (1 + s^2 a) - log(1 + s^2 a)) / 2,

and what it makes of all errors is N(P' y, P') with P'^-1 = L + (S + s^2 w w^T)^-1. No view is linearised again.
Neighbours err alike, and so do textures followed anew: for the variances of what is found L is divided by a factor.

A pair is the same all along. Views that speak of another one than all before them, by the ratio of the marginal
likelihoods of one pair and of two, come of a wrong pose or a loop, and are not heard.

A calibration that is worse than usual is so in many errors at once: of the factors by which all their standard
deviations may be larger, beside the hypotheses, the one of the largest marginal likelihood is taken (empirical Bayes,
"type 2 maximum likelihood": Bishop 2006, section 3.5). Where the usual ones suffice it is one.
"""

from dataclasses import dataclass, replace

import numpy as np

from sigmaslam.estimation.calibration_errors import ERRORS, SHOWN, CalibrationPrior
from sigmaslam.estimation.state_layout import CALIBRATION
from sigmaslam.estimation.window_state import WindowState
from sigmaslam.inference.onnx_graph import Step

# Of a hundred rigs one has this wrong. Below one in twenty a hypothesis is hopeless, and changes nothing.
_PRIOR, HOPELESS = 0.01, 0.05
# How large an error is that no calibration usually has, as a share of the focal length: half a degree, a per cent.
_SIZE = 0.01
# A file may claim that a calibration has no errors at all, as a share of the focal length.
_LEAST_SIGMA = 1e-6
_ALIKE = 8.0  # of streets, seeds 301 to 304, 700 to 704, 711 and 712
# Views of one keyframe in a thousand are of a wrong pose (-100 to -100,000 nats, others have -10 at worst). They stay
# in the window for six keyframes; what contradicts for longer than two windows is right.
_CONTRADICTION, _PATIENCE = np.log(0.001), 12
_WORSE = np.geomspace(1.0, 8.0, 13)  # V1 01 and KITTI have 2 to 8; a finer grid says no more of so few errors
HYPOTHESES = {
    "offset": ("offset",),  # a principal point
    "yaw": ("offset", "yaw"),
    "zoom": ("zoom",),  # one focal length
    "lenses": ("lenses",),  # radial distortion of one lens
    "lens": ("lens",),  # of both, alike
}
"""What each moves of the tracker's errors, all alike.

Baseline and focal length of both eyes cannot be told from the scene, a roll and a bend not from patches of a road that
are misplaced alike (docs/notebook/README.md). Rows show a pitch, and are corrected before tracking.
"""


@dataclass(frozen=True, slots=True)
class Cause:
    """A hypothesis as the views leave it.

    Attributes:
        probability: that this is wrong, and nothing else.
        mean, variance: of the error of its name, if so.
    """

    probability: float = 0.0
    mean: float = 0.0
    variance: float = 0.0


class CalibrationEvidence:
    """Weighs what may be wrong with a pair; owns a window with all errors of the calibration estimated.

    Args:
        usual: prior of a calibration with which nothing is wrong.
        focal_length: pixels.
        condition: `sigmaslam_models.estimator.window_solution.Condition`.
        expected: (15,) errors of the calibration about which the prior holds; zero by default.
    """

    def __init__(
        self, usual: CalibrationPrior, focal_length: float, condition: Step, expected: np.ndarray | None = None
    ) -> None:
        units = np.where(np.isin(ERRORS, ("focal", "baseline")), 1.0, focal_length)
        self._sigma = np.maximum(usual.sigma, _LEAST_SIGMA * units)
        self._is_uncertain = usual.sigma > 0.0
        # Standard deviation times direction of a hypothesis, in the usual sigmas: s w.
        self._gross = _SIZE * focal_length
        size = self._gross / self._sigma
        self._spreads = {name: size * np.isin(ERRORS, moved) for name, moved in HYPOTHESES.items()}
        self._condition = condition
        self.expected = np.zeros(len(ERRORS)) if expected is None else expected.copy()
        state = WindowState.initial(CalibrationPrior.independent(self._sigma, *ERRORS))
        self._prior = self._posterior = replace(state, calibration=self.expected.copy())
        self._contradicted = 0

    def restart(self) -> None:
        """Forgets all poses."""
        self._prior = self._posterior = self._posterior.without_poses()

    def add_keyframe(self, step: np.ndarray, step_covariance: np.ndarray) -> None:
        """As of the window; errors of a rig do not walk."""
        expected = self._prior.poses[-1] @ step if len(self._prior) else step
        self._prior = self._prior.grow(expected, step_covariance, np.zeros(len(ERRORS)))

    def move_poses(self, step: np.ndarray) -> None:
        """Lets the poses follow a loop (n,), which says nothing of views; where they stay, it looks like an error."""
        step = np.r_[np.zeros(len(ERRORS)), step[len(ERRORS) :]]
        self._prior = self._prior.moved(step, self._prior.covariance, self._prior.common)

    def learn(self, about: WindowState, information: np.ndarray, vector: np.ndarray) -> None:
        """Takes what all views of the window say, about the mean of its prior, unless it contradicts earlier ones."""
        self._posterior, _ = self._given(about, information, vector)

    def marginalise_oldest(self, about: WindowState, information: np.ndarray, vector: np.ndarray) -> None:
        """Takes what the views of leaving landmarks say, likewise, and forgets the oldest pose."""
        state, agrees = self._given(about, information, vector)
        self._contradicted = 0 if agrees else self._contradicted + 1
        state = state.marginalise_oldest()
        self._prior = replace(state, past=state.past.drop(0))

    def _given(self, about: WindowState, information: np.ndarray, vector: np.ndarray) -> tuple[WindowState, bool]:
        """The prior with what views say, if they are heard; whether they speak of the same pair as all before them."""
        vector = vector + information @ about.minus(self._prior)
        state = self._prior.given(information, vector, self._condition)
        before, after = (_shown(*self._in_usual_sigmas(each)) for each in (self._prior, state))
        views = after[0] - before[0], after[1] - before[1]
        agrees = _evidence(*after) - _evidence(*before) - _evidence(*views) > _CONTRADICTION
        return state if agrees or self._contradicted >= _PATIENCE else self._prior, agrees

    def weigh_frame(
        self,
        about: WindowState,
        step: np.ndarray,
        step_covariance: np.ndarray,
        information: np.ndarray,
        slope: np.ndarray,
    ) -> dict[str, Cause]:
        """`weigh` with what a frame's views say, of which nothing is kept.

        Args:
            about: window and frame, about which the views say so.
            step, step_covariance: of the frame from the last keyframe, as of `add_keyframe`.
            information, slope: (n, n) of the views, (n,) of their log-likelihood there.
        """
        known = self._posterior
        prior = known.grow(known.poses[-1] @ step, step_covariance, np.zeros(len(ERRORS)))
        return self.weigh(prior.given(information, slope + information @ about.minus(prior), self._condition))

    def weigh(self, state: WindowState | None = None) -> dict[str, Cause]:
        """What may be wrong, by its name, unless it is hopeless; "nothing" has the rest of the probability."""
        usual, sigma = np.eye(len(ERRORS)), self._sigma
        mean, covariance, precision = self._in_usual_sigmas(state or self._posterior)
        found: dict[str, tuple[float, float, float]] = {}
        for name in HYPOTHESES:
            spread = self._spreads[name]
            growth = 1.0 + spread @ (usual - covariance) @ spread
            ratio = 0.5 * ((spread @ mean) ** 2 / growth - np.log(growth))
            k, own = ERRORS.index(name), np.linalg.inv(usual + np.outer(spread, spread))
            value = (np.linalg.inv(precision - usual + own) @ (precision @ mean))[k]
            variance = np.linalg.inv((precision - usual) / _ALIKE + own)[k, k]
            found[name] = float(ratio), float(sigma[k] * value), float(sigma[k] ** 2 * variance)
        top = max(0.0, *(ratio for ratio, _, _ in found.values()))
        weights = {name: _PRIOR * np.exp(ratio - top) for name, (ratio, _, _) in found.items()}
        total = (1.0 - _PRIOR * len(found)) * np.exp(-top) + sum(weights.values())
        return {k: Cause(odds / total, *found[k][1:]) for k, odds in weights.items() if odds > HOPELESS * total}

    def is_gross(self, causes: dict[str, Cause]) -> bool:
        """Whether one is likely that no calibration usually has: what it does is no longer linear."""
        return any(cause.probability > 0.5 and abs(cause.mean) > self._gross for cause in causes.values())

    def beside(self, causes: dict[str, Cause]) -> tuple[np.ndarray, float]:
        """What images show of all errors together beside these causes; views count by a part.

        Returns:
            (15,) the errors that they show, by the usual sigmas; by what factor these errors are larger, 1 or more.
        """
        identity, (information, vector) = np.eye(len(ERRORS)), _shown(*self._in_usual_sigmas(self._posterior))
        spreads = [np.sqrt(cause.probability) * self._spreads[name] for name, cause in causes.items()]
        more = sum((np.outer(each, each) for each in spreads), np.zeros_like(identity))
        shown = np.isin(ERRORS, SHOWN) & self._is_uncertain
        priors = identity * np.where(shown, _WORSE[:, None] ** 2, 1.0)[:, None] + more
        seen = identity + priors @ information
        errors = np.linalg.solve(seen, (priors @ vector)[..., None])[..., 0]
        likelihoods = errors @ vector - np.linalg.slogdet(seen)[1]
        return np.where(shown, errors[0] * self._sigma, 0.0), float(_WORSE[int(np.argmax(likelihoods))])

    def _in_usual_sigmas(self, state: WindowState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean (15,), covariance and precision (15, 15) of the errors in the usual sigmas: S is the identity there."""
        covariance = state.covariance[CALIBRATION, CALIBRATION] / np.outer(self._sigma, self._sigma)
        return (state.calibration - self.expected) / self._sigma, covariance, np.linalg.inv(covariance)


def _shown(mean: np.ndarray, covariance: np.ndarray, precision: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """L (15, 15) and y (15,) of a state in the usual sigmas, by the part that views count."""
    return (precision - np.eye(len(ERRORS))) / _ALIKE, precision @ mean / _ALIKE


def _evidence(information: np.ndarray, vector: np.ndarray) -> float:
    """Log marginal likelihood of exp(-x^T L x / 2 + y^T x) for errors x of any pair, up to a constant."""
    seen = np.eye(len(ERRORS)) + _WORSE[-1] ** 2 * information
    return float(0.5 * _WORSE[-1] ** 2 * vector @ np.linalg.solve(seen, vector) - 0.5 * np.linalg.slogdet(seen)[1])
