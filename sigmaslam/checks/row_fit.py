"""Row differences between the eyes in terms of what causes them: a shift, a turned or enlarged eye, a delay."""

from dataclasses import dataclass

import numpy as np

from sigmaslam.checks.eye_matches import EyeMatches
from sigmaslam.estimation.gaussian import robust_sigma
from sigmaslam.geometry.camera import RectifiedStereo

_ITERATIONS = 20
# Scale of the robust loss in robust standard deviations, and the smallest such deviation, pixels.
_ROBUST, _MIN_SIGMA = 2.0, 0.05
# Causes count where they are larger than so many standard deviations.
SIGNIFICANT = 5.0
# A lag that each pair shows by itself is so many standard deviations by pairs, of which there are few.
_STEADY = 3.0
# Rigs are compared by residuals up to about this size, pixels: matches err by 0.1 to 0.2.
_COMPARED = 0.3
MIN_INLIERS = 15
"""A pose needs so many matches that agree; as in `sigmaslam.TrackerConfig`."""
MIN_MATCHES = 3 * MIN_INLIERS
"""So many matches are needed to judge a rig, as the tracker needs for a pose that it did not expect."""
# Without this vertical motion of a tenth of the points, pixels, rows say nothing about a delay.
_MIN_FLOW = 1.0


@dataclass(frozen=True, slots=True)
class RowFit:
    """Row differences of matches by least squares with Geman and McClure's loss.

    Attributes:
        matches: those that were fitted.
        shift: rows in the middle of the image, pixels.
        roll, zoom, yaw: of the right camera, pixels at unit normalised coordinates about the middle of the
            image: row differences with x, y, x y.
        lag: frames by which the right images are later than the left ones; NaN where the motion does not show it.
        sigmas: (5,) standard deviations of all these, in this order.
        unit: (M,) what a pixel of each of shift, roll, zoom and yaw makes of the rows, by these names.
        by_lag: (M, 2) what the lag makes of the right places, pixels.
        residual: (M,) row differences that are left, pixels.
    """

    matches: EyeMatches
    shift: float
    roll: float
    zoom: float
    yaw: float
    lag: float
    sigmas: np.ndarray
    unit: dict[str, np.ndarray]
    by_lag: np.ndarray
    residual: np.ndarray

    @property
    def disparity(self) -> np.ndarray:
        """(M,) disparities without what yaw and lag add to them, pixels."""
        yaw = self.yaw if abs(self.yaw) > SIGNIFICANT * self.sigmas[3] else 0.0
        return np.asarray(self.matches.disparity + yaw + self.by_lag[:, 0])

    @property
    def lag_shift(self) -> float:
        """What the lag makes of the median right place, pixels; zero where it is not significant."""
        if not abs(self.lag) > SIGNIFICANT * self.sigmas[4]:
            return 0.0
        return float(np.median(np.linalg.norm(self.by_lag, axis=1)))

    def most(self, *causes: str) -> float:
        """Pixels by which causes together move rows in a tenth of the places at least."""
        return float(np.percentile(np.abs(sum(getattr(self, name) * self.unit[name] for name in causes)), 90))

    def agreement(self, tolerance: float) -> float:
        """Share that a parallel pair with these errors has: rows within `tolerance` px, disparity above -0.5 of it."""
        return float(((np.abs(self.residual) <= tolerance) & (self.disparity > -0.5 * tolerance)).mean())


def fit_rows(matches: EyeMatches, camera: RectifiedStereo) -> RowFit:
    """Fit of `matches`, at least 5, in the rectified pair `camera`."""
    followed = np.isfinite(matches.flow).all(axis=1)
    moving = followed.sum() >= MIN_MATCHES and np.percentile(np.abs(matches.flow[followed, 1]), 90) >= _MIN_FLOW
    if moving:
        matches = matches.select(followed)
    rows, chances, columns = matches.row_difference, matches.probability, _columns(matches, camera, moving)
    coefficients, sigmas, count = np.zeros(5), np.full(5, np.nan), 4 + moving
    coefficients[:count], sigmas[:count] = _fit(columns[:, :count], rows, chances)
    if moving:
        # A bump between two pairs lowers all rows of the later ones, which is no delay: let each have its own shift.
        own = _fit(np.column_stack([columns, matches.pair[:, None] == np.unique(matches.pair)[1:]]), rows, chances)
        if abs(own[0][4] - coefficients[4]) > SIGNIFICANT * np.hypot(own[1][4], sigmas[4]):
            coefficients[4], sigmas[4] = own[0][4], own[1][4]
            coefficients[:4], sigmas[:4] = _fit(columns[:, :4], rows - coefficients[4] * columns[:, 4], chances)
    shift, roll, zoom, yaw, lag = coefficients.tolist()
    unit = dict(zip(("shift", "roll", "zoom", "yaw"), columns[:, :4].T, strict=True))
    flow = matches.flow if moving else np.zeros_like(matches.flow)
    places = unit, lag * flow, rows - columns @ coefficients
    return RowFit(matches, shift, roll, zoom, yaw, lag if moving else np.nan, sigmas, *places)


def follows_motion(fit: RowFit) -> bool:
    """Whether all pairs show about the same lag, when a bend that stays in the image, as of a lens, is fitted, too."""
    matches, x, y, pairs = fit.matches, fit.unit["roll"], fit.unit["zoom"], np.unique(fit.matches.pair)
    if len(pairs) == 1:
        return False
    bends = [x, y, x * y, x * x, y * y, x**3, x * x * y, x * y * y, y**3]
    columns = np.column_stack([fit.unit["shift"], matches.flow[:, 1], *bends])
    parts = [slice(None), *(matches.pair != pair for pair in pairs)]
    rows, chances = matches.row_difference, matches.probability
    (lag, sigma), *without = [[each[1] for each in _fit(columns[k], rows[k], chances[k])] for k in parts]
    jackknife = np.sqrt(len(pairs) - 1.0) * np.std([each for each, _ in without])
    return bool(abs(lag) > max(SIGNIFICANT * sigma, _STEADY * jackknife, 2.0 * abs(lag - fit.lag)))


def misfit(matches: EyeMatches, camera: RectifiedStereo) -> float:
    """Mean loss, 0 to 1, of row differences that no delay explains.

    A delay would hide a pitch that was taken for another principal point: what it leaves goes with y^2, and so do the
    rows of a road ahead.
    """
    columns, rows, chances = _columns(matches, camera, False)[:, :4], matches.row_difference, matches.probability
    squared = ((rows - columns @ _fit(columns, rows, chances)[0]) / _COMPARED) ** 2
    return float(np.average(squared / (1.0 + squared), weights=chances))


def _columns(matches: EyeMatches, camera: RectifiedStereo, moving: bool) -> np.ndarray:
    """(M, 5) what a unit of shift, roll, zoom, yaw and lag makes of rows; nothing of a lag that does not show."""
    x, y = ((matches.right - 0.5 * np.array([camera.width - 1, camera.height - 1])) / [camera.fx, camera.fy]).T
    return np.column_stack([np.ones(len(x)), x, y, x * y, matches.flow[:, 1] if moving else np.zeros(len(x))])


def _fit(columns: np.ndarray, values: np.ndarray, probability: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (k,) and standard deviations (k,) of values (M,) by columns (M, k), the first of which is one."""
    coefficients = np.zeros(columns.shape[1])
    coefficients[0] = np.median(values)
    damping = 1e-9 * np.eye(len(coefficients))
    for _ in range(_ITERATIONS):
        residual = values - columns @ coefficients
        sigma = max(float(robust_sigma(residual)), _MIN_SIGMA)
        weighted = columns * (probability / (1.0 + (residual / (_ROBUST * sigma)) ** 2) ** 2)[:, None]
        normal = weighted.T @ columns
        normal += damping * np.trace(normal)
        coefficients = np.linalg.solve(normal, weighted.T @ values)
    return coefficients, sigma * np.sqrt(np.diag(np.linalg.inv(normal)))
