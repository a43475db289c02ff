"""Relative orientation of two views where much may be wrong or little known: many starts, one honest covariance."""

from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np

from sigmaslam.geometry.se3 import rotation_exp, rotation_log
from sigmaslam.two_view.epipolar import (
    MIN_MATCHES,
    MIN_PROBABILITY,
    SIGMA0,
    THRESHOLD,
    EpipolarPose,
    MatchedRays,
    log_gain,
    most_in_front,
    neighbours_factor,
    pose_of_essential,
    poses_of_plane,
    robust_weight,
    soft_weight,
)

# The sampling consensus stops when it is this sure of a right sample, which takes 3,800 of them where 0.3 of the
# matches are right; 0.2 would take 29,000.
_CONFIDENCE, _MAX_SAMPLES = 0.9999, 20_000
# A homography may be that of a plane if it has this share of the matches of the essential matrix.
_PLANE_SHARE, _PLANE_SAMPLES = 0.5, 2000
# Standard deviations up to which a match counts in full: 0.997 of the right ones are within.
_GATE = 3.0
# A match is not counted where its parallax is so many times the median: wrong ones have the largest by far, and with
# them the greatest leverage. Points nearer than a sixth of the usual depth are lost.
_MOST_PARALLAX = 6.0
# Starts drawn about the best pose, so many standard deviations wide.
_STARTS, _WIDTH = 20, 4.0
# The first steps have a loss so much wider.
_WIDER = 2.0
# Steps with the wide loss, with the narrow one, and the radians below which they end: a hundredth of a pixel.
_WIDE_STEPS, _STEPS, _CONVERGED, _LONGEST_STEP = 4, 15, 1e-5, 0.5
# Matches so many standard deviations from all of the first poses are wrong in all others as well.
_HOPELESS = 10.0
# Variance, radians squared, of either angle of a direction of which nothing is known: uniform on the sphere.
_UNKNOWN_DIRECTION = (np.pi**2 - 4.0) / 4.0
# Its information beside that of the rotation, of which nothing is known either.
_PRIOR = np.diag([0.0, 0.0, 0.0, 1.0 / _UNKNOWN_DIRECTION, 1.0 / _UNKNOWN_DIRECTION])
# If the inliers depart from a turn by no more than this, relative to their variance across the lines, nothing is known
# of the direction: without a translation it is 1 to 1.3, as the lines are those that suit the errors best.
_NO_PARALLAX = 2.0
# All but a few of the inliers are within three standard deviations of where a plane puts them, and their variance is
# no more than so many times that across the lines, if they are on one.
_FLAT_SHARE, _FLAT = 0.95, 1.3
# A match of a larger leverage is nearly alone with what it says: were it wrong, its residual would not show it.
_LEVERAGE = 0.5
# Squared distance, in standard deviations per pose, below which two poses are one.
_SAME = 0.02


@dataclass(frozen=True, slots=True)
class RelativeOrientation(EpipolarPose):
    """A pose as `EpipolarPose` with the uncertainty of the choice among several.

    The covariance of the direction is that of the angles from it, of rank 2; where nothing is known of it, that of a
    uniform one.

    Attributes:
        covariance: (6, 6) of direction before rotation: direction + d, of rank 2, and exp(r) R, radians.
        rival: probability that another pose, which is not near, is the right one, from 0 to 1.
        rival_angles: of the most probable such pose: differences in rotation and direction, radians; 0 without one.
    """

    covariance: np.ndarray
    rival: float
    rival_angles: tuple[float, float]


def estimate_relative_orientation(
    K: np.ndarray, points0: np.ndarray, points1: np.ndarray, probability: np.ndarray, covariance: np.ndarray
) -> RelativeOrientation | None:
    """Pose that the matches agree on, each weighted by its probability and covariance.

    The 5-point method in a sampling consensus that draws as many samples as the share of right matches needs, and the
    poses of a plane, give the first poses; twenty more are drawn about the best. Each is refined by Gauss-Newton on
    Sampson's error, first with Geman and McClure's loss, then with one that is that of least squares up to three
    standard deviations. A match whose rays meet behind the cameras is moved to infinity, and costs what that takes.
    The covariance is that of the mixture of all poses found (Laplace's approximation of each), times what clusters of
    errors add. Arguments, and None for a pose, are as of `estimate_epipolar_pose`.
    """
    probable = np.flatnonzero(probability >= MIN_PROBABILITY)
    if len(probable) < MIN_MATCHES:
        return None
    K = np.ascontiguousarray(K, np.float64)  # OpenCV misreads a view of a projection matrix
    pixels0, pixels1 = points0[probable].astype(np.float64), points1[probable].astype(np.float64)
    K_inverse = np.linalg.inv(K)
    rays0, rays1 = (np.c_[pixels, np.ones(len(pixels))] @ K_inverse.T for pixels in (pixels0, pixels1))
    J = K_inverse[:2, :2]
    rays = MatchedRays(rays0, rays1, SIGMA0**2 * J @ J.T, J @ covariance[probable].astype(np.float64) @ J.T)
    starts = _starts(K, pixels0, pixels1, rays)
    if not starts:
        return None
    weight = probability[probable].astype(np.float64)
    first = [_refine(rays, weight, *start) for start in starts]
    hopeful = np.min([_at(rays, *pose).squared for pose in first], axis=0) < _HOPELESS**2
    if hopeful.sum() < MIN_MATCHES:
        return None
    probable, pixels0, weight = probable[hopeful], pixels0[hopeful], weight[hopeful]
    rays = rays.chosen(hopeful)
    fits = [_Fit.of(rays, weight, *pose) for pose in first]
    rng = np.random.default_rng(0)
    for _ in range(_STARTS):
        best = min(fits, key=lambda fit: fit.cost)
        step = _WIDTH * np.linalg.cholesky(best.covariance) @ rng.standard_normal(5)
        fits.append(_Fit.of(rays, weight, *_refine(rays, weight, *_moved(best.R, best.direction, step))))
    best = min(fits, key=lambda fit: fit.cost)
    if _on_plane(rays, weight, best) is not None:
        fits = [_on_plane(rays, weight, fit) or fit for fit in fits]
        best = min(fits, key=lambda fit: fit.cost)
    fits += _without_levers(rays, weight, best)
    at = _at(rays, best.R, best.direction)
    scores = np.where(best.inliers[:, None], at.J * at.residual[:, None], 0.0)
    clusters = neighbours_factor(pixels0, scores, np.linalg.inv(best.covariance))
    spread, rival, angles = _mixture(fits, best, clusters)
    R, turned_alone = best.R, _turn_alone(rays, best)
    if turned_alone is not None:
        R, by_turn = turned_alone
        spread, rival, angles = np.diag([0.0] * 3 + [_UNKNOWN_DIRECTION] * 2), 0.0, (0.0, 0.0)
        spread[:3, :3] = clusters * by_turn
    inliers = np.zeros(len(points0), bool)
    inliers[probable[best.inliers]] = True
    expand = np.zeros((6, 5))
    expand[:3, 3:], expand[3:, :3] = at.tangent, np.eye(3)
    return RelativeOrientation(R, best.direction, inliers, expand @ spread @ expand.T, rival, angles)


def _starts(
    K: np.ndarray, points0: np.ndarray, points1: np.ndarray, rays: MatchedRays
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Poses of the essential matrix that the matches agree on, and of the homography if most of them follow one."""
    E, mask = cv2.findEssentialMat(
        points0, points1, K, method=cv2.USAC_ACCURATE, prob=_CONFIDENCE, threshold=THRESHOLD, maxIters=_MAX_SAMPLES
    )
    # OpenCV returns None on failure, although its type hints exclude None.
    if np.shape(E) != (3, 3):
        return []
    agreeing = mask.ravel() > 0
    seen = rays.rays0[agreeing], rays.rays1[agreeing]
    least = _PLANE_SHARE * float(agreeing.sum())
    plane = poses_of_plane(K, points0, points1, cv2.USAC_ACCURATE, _PLANE_SAMPLES, least)
    return [pose_of_essential(E, *seen), *(most_in_front([pose], *seen) for pose in plane)]


@dataclass(frozen=True, slots=True)
class _Residuals:
    """Whitened residuals (M,) of matches at a pose, and derivatives (M, 5) by rotation and direction.

    `residual` is across the epipolar lines (Sampson), `behind` along them, of matches that would have to be moved to
    infinity, else 0; `parallax` (M,) is the distance from there, and `tangent` (3, 2) how the direction may move.
    """

    residual: np.ndarray
    J: np.ndarray
    behind: np.ndarray
    J_behind: np.ndarray
    parallax: np.ndarray
    tangent: np.ndarray

    @property
    def squared(self) -> np.ndarray:
        return np.asarray(self.residual**2 + self.behind**2)

    def usual(self, weight: np.ndarray) -> np.ndarray:
        """(M,) bool, the parallax is no larger than that of most matches by far, these weighted (M,)."""
        order = np.argsort(self.parallax)
        total = np.cumsum(weight[order])
        median = self.parallax[order][np.searchsorted(total, 0.5 * total[-1])]
        return np.asarray(self.parallax <= _MOST_PARALLAX * median)


def _at(rays: MatchedRays, R: np.ndarray, direction: np.ndarray) -> _Residuals:
    turned = rays.rays0 @ R.T
    across = np.cross(rays.rays1, direction)
    line1, line0 = np.cross(direction, turned), across @ R
    slope1, slope0 = np.einsum("mij,mj->mi", rays.spread1, line1[:, :2]), line0[:, :2] @ rays.spread0
    variance = np.maximum((slope1 * line1[:, :2]).sum(axis=1) + (slope0 * line0[:, :2]).sum(axis=1), 1e-24)
    sigma = np.sqrt(variance)
    residual = (rays.rays1 * line1).sum(axis=1) / sigma
    # Of the lines in either image, by the three turns and the two angles of the direction.
    tangent = np.linalg.svd(direction[None])[2][1:].T
    axes = np.eye(3)
    by1 = np.concatenate(
        [
            (turned @ direction)[:, None, None] * axes - turned[:, None] * direction[:, None],
            np.cross(tangent.T, turned[:, None]),
        ],
        axis=1,
    )
    by0 = np.concatenate([np.cross(across[:, None], axes), np.cross(rays.rays1[:, None], tangent.T)], axis=1) @ R
    by_variance = by1[..., :2] @ slope1[..., None] + by0[..., :2] @ slope0[..., None]
    J = (by1 @ rays.rays1[..., None])[..., 0] / sigma[:, None] - (residual / variance)[:, None] * by_variance[..., 0]
    # Where a point at infinity would be, and the way that it goes as it comes nearer.
    depth = turned[:, 2]
    infinite = turned[:, :2] / depth[:, None]
    way = direction[:2] - infinite * direction[2]
    way = way / np.maximum(np.linalg.norm(way, axis=1), 1e-12)[:, None]
    parallax = rays.rays1[:, :2] - infinite
    sigma = np.sqrt(np.einsum("mi,mij,mj->m", way, rays.spread1 + rays.spread0, way))
    along = (way * parallax).sum(axis=1) / sigma
    by_turned = np.c_[way, -(way * infinite).sum(axis=1)] / depth[:, None]
    J_behind = np.where((along < 0.0)[:, None], -np.cross(turned, by_turned) / sigma[:, None], 0.0)
    J_behind = np.c_[J_behind, np.zeros((len(along), 2))]
    return _Residuals(residual, J, np.minimum(along, 0.0), J_behind, np.linalg.norm(parallax, axis=1), tangent)


def _moved(R: np.ndarray, direction: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pose after a step (5,) of rotation and angles of the direction, radians."""
    along = np.linalg.svd(direction[None])[2][1:].T @ step[3:]
    angle = max(float(np.linalg.norm(along)), 1e-15)
    direction = np.cos(angle) * direction + np.sin(angle) / angle * along
    return rotation_exp(step[:3]) @ R, direction / np.linalg.norm(direction)


def _refine(
    rays: MatchedRays, probability: np.ndarray, R: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton over the five degrees of freedom."""
    for turn in range(_WIDE_STEPS + _STEPS):
        at = _at(rays, R, direction)
        loss = robust_weight(np.sqrt(at.squared) / _WIDER) if turn < _WIDE_STEPS else soft_weight(at.squared)
        weight = probability * loss
        weight = weight * at.usual(weight)
        normal, gradient = _PRIOR.copy(), np.zeros(5)
        for J, residual in ((at.J, at.residual), (at.J_behind, at.behind)):
            weighted = weight[:, None] * J
            normal += weighted.T @ J
            gradient += weighted.T @ residual
        # With too few matches nothing may hold the rotation.
        step = -np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(5), gradient)
        step *= min(1.0, _LONGEST_STEP / max(float(np.linalg.norm(step)), 1e-15))
        R, direction = _moved(R, direction, step)
        if turn >= _WIDE_STEPS and np.abs(step).max() < _CONVERGED:
            break
    return R, direction


@dataclass(frozen=True, slots=True)
class _Fit:
    """A refined pose, and twice its negative log-likelihood, `cost`.

    `scale` is the variance of the residuals of inliers (M,), 1 or more: matches are not taken to be better than they
    say. The covariance (5, 5) is of rotation and angles of the direction.
    """

    R: np.ndarray
    direction: np.ndarray
    cost: float
    inliers: np.ndarray
    scale: float
    covariance: np.ndarray

    @classmethod
    def of(cls, rays: MatchedRays, probability: np.ndarray, R: np.ndarray, direction: np.ndarray) -> Self:
        at = _at(rays, R, direction)
        usual = at.usual(probability * soft_weight(at.squared))
        cost = -2.0 * float((probability * usual * log_gain(at.squared)).sum())
        inliers = (at.squared < _GATE**2) & usual
        scale = max(1.0, float((at.residual[inliers] ** 2).sum()) / max(int(inliers.sum()) - 5, 1))
        J, J_behind = at.J[inliers], at.J_behind[inliers]
        information = (J.T @ J + J_behind.T @ J_behind) / scale + _PRIOR
        information += 1e-9 * np.trace(information) * np.eye(5)
        return cls(R, direction, cost, inliers, scale, np.linalg.inv(information))


def _fit_places(
    rays: MatchedRays, R: np.ndarray, direction: np.ndarray, free: slice
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pose of points on the plane normal . X = distance (over the baseline's length) by both coordinates in image 1.

    Of rotation, angles of the direction and normal those that are `free` move. Last come squared errors (M,) in
    standard deviations, and the information of what is free.
    """
    normal, inverse = np.zeros(3), np.linalg.inv(rays.spread1 + rays.spread0)
    for turn in range(_WIDE_STEPS + _STEPS):
        turned, tangent = rays.rays0 @ R.T, np.linalg.svd(direction[None])[2][1:]
        along = (rays.rays0 @ normal)[:, None]
        seen = turned + along * direction
        slopes = [np.cross(axis, turned) for axis in np.eye(3)] + [along * way for way in tangent]
        slopes += [rays.rays0[:, k : k + 1] * direction for k in range(3)]
        by_seen, depth = np.stack(slopes, axis=2), seen[:, 2, None, None]
        J = (by_seen[:, :2] - seen[:, :2, None] / depth * by_seen[:, 2:]) / depth
        error = rays.rays1[:, :2] - seen[:, :2] / seen[:, 2:]
        squared = np.einsum("mi,mij,mj->m", error, inverse, error)
        wide = turn < _WIDE_STEPS
        loss = robust_weight(np.sqrt(squared) / _WIDER) if wide else soft_weight(squared)
        # The plane is found before the pose moves, at first by least squares.
        moves = np.r_[5:8] if wide and free.stop > 5 else np.r_[free]
        weighted = J[..., moves].transpose(0, 2, 1) @ inverse * (loss if turn else np.ones_like(loss))[:, None, None]
        information = (weighted @ J[..., moves]).sum(axis=0)
        step = np.zeros(8)
        step[moves] = np.linalg.lstsq(information, (weighted @ error[..., None]).sum(axis=0)[:, 0], rcond=1e-12)[0]
        (R, direction), normal = _moved(R, direction, step[:5]), normal + step[5:]
        if not wide and np.abs(step[:5]).max() < _CONVERGED:
            break
    return R, direction, squared, information


def _turn_alone(rays: MatchedRays, best: _Fit) -> tuple[np.ndarray, np.ndarray] | None:
    """Rotation and its covariance (3, 3) if the inliers follow a mere turn within their errors, else None.

    The turn that takes the rays nearest to each other (Kabsch 1976) is as good as the best one where errors are alike.
    """
    near = rays.chosen(best.inliers)
    R, _, squared, information = _fit_places(near, best.R, best.direction, slice(0, 3))
    variance = float(squared.mean()) / 2.0
    if variance > _NO_PARALLAX * float((_at(near, best.R, best.direction).residual ** 2).mean()):
        return None
    # A translation that the errors hide looks like a turn by as much as they are.
    hidden = float(np.trace(near.spread1 + near.spread0, axis1=1, axis2=2).mean()) / 2.0
    return R, max(1.0, variance) * (np.linalg.inv(information) + hidden * np.eye(3))


def _on_plane(rays: MatchedRays, probability: np.ndarray, fit: _Fit) -> _Fit | None:
    """The fit by both coordinates of the inliers if they are on one plane within their errors, else None."""
    if fit.inliers.sum() < MIN_MATCHES:
        return None
    R, direction, squared, known = _fit_places(rays.chosen(fit.inliers), fit.R, fit.direction, slice(0, 8))
    flat = squared < _GATE**2
    scale = float(squared[flat].sum()) / max(2 * int(flat.sum()) - 8, 1)
    if flat.mean() < _FLAT_SHARE or scale > _FLAT * fit.scale:
        return None
    known = known[:5, :5] - known[:5, 5:] @ np.linalg.pinv(known[5:, 5:]) @ known[5:, :5]
    covariance = np.linalg.inv(known / max(1.0, scale) + _PRIOR)
    return replace(_Fit.of(rays, probability, R, direction), covariance=covariance)


def _without_levers(rays: MatchedRays, probability: np.ndarray, best: _Fit) -> list[_Fit]:
    """Fits beside the best one, each without one of its matches that decides a direction nearly alone."""
    J = _at(rays, best.R, best.direction).J
    fits = []
    for match in np.flatnonzero(best.inliers & (((J @ best.covariance) * J).sum(axis=1) > _LEVERAGE * best.scale)):
        others, rest = rays.chosen(np.arange(len(J)) != match), np.delete(probability, match)
        fits.append(_Fit.of(others, rest, *_refine(others, rest, best.R, best.direction)))
    return fits


def _mixture(fits: list[_Fit], best: _Fit, clusters: float) -> tuple[np.ndarray, float, tuple[float, float]]:
    """Covariance (5, 5) about the best of several, the probability of those that are not near it, and how far the most
    probable of these is in rotation and direction, radians; variances are too small by the factor `clusters`."""
    tangent = np.linalg.svd(best.direction[None])[2][1:].T
    information = np.linalg.inv(best.covariance)
    steps: list[np.ndarray] = []
    weights, spreads = [], []
    for fit in sorted(fits, key=lambda fit: fit.cost):
        along = fit.direction - (best.direction @ fit.direction) * best.direction
        angle = np.arctan2(np.linalg.norm(along), best.direction @ fit.direction)
        along = along * (angle / max(float(np.linalg.norm(along)), 1e-15))
        step = np.r_[rotation_log(fit.R @ best.R.T), along @ tangent]
        if any((step - other) @ information @ (step - other) < _SAME for other in steps):
            continue
        steps.append(step)
        likelihood = (best.cost - fit.cost) / (best.scale * clusters)
        weights.append(0.5 * (likelihood + np.linalg.slogdet(fit.covariance)[1]))
        turn = np.eye(5)
        turn[3:, 3:] = tangent.T @ np.linalg.svd(fit.direction[None])[2][1:].T
        known = (np.linalg.inv(fit.covariance) - _PRIOR) / clusters + _PRIOR
        spreads.append(turn @ np.linalg.inv(known) @ turn.T)
    share = np.exp(np.array(weights) - max(weights))
    share /= share.sum()
    spread = sum(w * (C + np.outer(step, step)) for w, C, step in zip(share, spreads, steps, strict=True))
    far = [bool(step @ information @ step > 2.0 * 5.0 * _GATE**2) for step in steps]
    if not any(far):
        return np.asarray(spread), 0.0, (0.0, 0.0)
    rival = steps[int(np.argmax(np.where(far, share, -1.0)))]
    angles = float(np.linalg.norm(rival[:3])), float(np.linalg.norm(rival[3:]))
    return np.asarray(spread), float(share[far].sum()), angles
