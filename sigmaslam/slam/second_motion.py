"""Whether the matches that disagree with a pose agree with another one: something else moves, or the image is torn."""

from dataclasses import dataclass, replace

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.chi_square import CHI_SQUARE_95, CHI_SQUARE_99_OF_6, CHI_SQUARE_9999_OF_6
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.mahalanobis import quantiles
from sigmaslam.estimation.prediction_errors import surprise
from sigmaslam.estimation.state_layout import CALIBRATION
from sigmaslam.geometry.image_cells import explained_area, image_cells
from sigmaslam.geometry.se3 import se3_inverse, se3_log, turn_covariance
from sigmaslam.slam.doubt import Doubts
from sigmaslam.slam.guided_matching import CONFIRMED, GuidedMatches
from sigmaslam.slam.landmark_places import seen_from
from sigmaslam.slam.localisation import Localiser, Prediction
from sigmaslam.slam.moving_region import MovingRegion
from sigmaslam.two_view.scene_pose import are_one_place, see_the_same, stands_before
from sigmaslam.two_view.stereo_pose import MIN_POINTS, estimate_relative_pose

# Shares of the matches that are farther than those that may be on what moves before the scene.
_FARTHER = np.array([0.8, 0.65, 0.5])


@dataclass(frozen=True, slots=True)
class SecondMotion:
    """Another pose that a part of the matches asks for.

    Attributes:
        first: the pose beside which it is one.
        pose: (4, 4) T_world_camera as if these landmarks stood still.
        covariance: (6, 6) of it relative to the first, perturbed from the left in the world.
        agreeing: (K,) numbers of the matches.
        expected: (K, 3) (u, v, disparity) where the first pose sees them.
        departure: (K, 2) pixels from there to where they are.
        is_mover: something before the scene, too small for a rival of it or never at rest, or what is farther says so.
            What lies behind may be the scene, and the first pose that of what moves before it.
    """

    first: FrameFit
    pose: np.ndarray
    covariance: np.ndarray
    agreeing: np.ndarray
    expected: np.ndarray
    departure: np.ndarray
    is_mover: bool


def find_second_motion(
    window: KeyframeWindow, matches: GuidedMatches, fit: FrameFit, moving: MovingRegion | None
) -> SecondMotion | None:
    """The pose of most matches that disagree with `fit`.

    None where they have none in common, or one like that of it, or where it explains too little of the image. What
    stands before the scene needs neither once something has been seen to move.
    They are held against where the fit's pose sees the landmarks, as if that were a keyframe: `estimate_relative_pose`.

    Args:
        moving: where the scene moves on its own; None: all of it may, but for one body.
    """
    views, camera = matches.views, window.camera
    rows = views.landmark
    if len(rows) - fit.count < MIN_POINTS:
        return None
    expected = seen_from(window, rows, fit.pose)
    others = np.flatnonzero(~fit.inliers & np.isfinite(expected).all(axis=1))
    cells, equal = image_cells(views.measurement[:, :2], camera.width, camera.height), np.ones(len(rows))
    possible, least = _among(others, len(rows)), 0.0
    if not moving:
        departs = np.linalg.norm(views.measurement[others, :2] - expected[others, :2], axis=1)
        possible = _most_departing(cells, others, departs)
        is_many = possible.sum() >= ACCEPTANCE.mover_points * MIN_POINTS
        least = ACCEPTANCE.mover if is_many and moving is not None else ACCEPTANCE.second_motion
    first, most = (explained_area(cells, each, equal) for each in (fit.inliers, possible))
    if possible.sum() < MIN_POINTS or most < least * (first + most):
        return None
    landmarks, seen, noise = window.landmarks, views.measurement[others], views.covariance[others]
    sigma = np.sqrt(np.diagonal(landmarks.covariance[rows[others], :3, :3], axis1=1, axis2=2))
    relative = estimate_relative_pose(camera, expected[others], sigma, seen, noise, matches.probability[others])
    if relative is None:
        return None
    agreeing = others[relative.inliers]
    area = explained_area(cells, _among(agreeing, len(rows)), equal)
    share = area / (first + area)
    departure = views.measurement[agreeing, :2] - expected[agreeing, :2]
    apart = np.linalg.norm(departure, axis=1)
    nearer = stands_before(*(float(np.median(expected[chosen, 2])) for chosen in (agreeing, fit.inliers)))
    differs, many = not see_the_same(apart), len(agreeing) >= ACCEPTANCE.mover_points * MIN_POINTS
    is_rival = differs and share >= ACCEPTANCE.second_motion
    moves = moving is not None and nearer and (bool(moving) or (differs and many and share >= ACCEPTANCE.mover))
    if not (is_rival or moves):
        return None
    is_mover = nearer and (share < ACCEPTANCE.second_motion or np.median(landmarks.views[rows[agreeing]]) < CONFIRMED)
    pose = fit.pose @ relative.T_key_camera
    own = relative.with_shared_errors(window.posterior.whole_covariance[CALIBRATION, CALIBRATION]).covariance
    return SecondMotion(fit, pose, turn_covariance(pose, own), agreeing, expected[agreeing], departure, is_mover)


def find_scene_behind(
    localiser: Localiser, matches: GuidedMatches, fit: FrameFit, doubts: Doubts
) -> SecondMotion | None:
    """What moves before farther landmarks, and their pose; None where nearer ones agree with that.

    Far parts hardly tell a translation: a body before them decides it, and all agree. The scores show it to first
    order; only where they do the pose of the others is found, which costs as much as another fit.

    Where nearer landmarks may move, but too little to be told from what rests, `doubts` takes the step that they draw
    the pose by. One that 95 % of the others' errors do not reach leaves the pose as uncertain as they know it.
    """
    window, views = localiser.window, matches.views
    rows, prediction = views.landmark, Prediction.of(window, localiser.motion)
    # Far parts would side with a prediction that the image contradicts, and near ones seem to move.
    excess = surprise(localiser.motion, fit.step)
    if excess > 1.0:
        prediction = Prediction(prediction.pose, excess * prediction.covariance)
        fit = localiser.fit_again(matches, fit, prediction)
    disparity = window.landmarks.estimate[rows, 2]
    most = 0.0
    for least in quantiles(disparity[fit.inliers], _FARTHER):
        near = disparity > least
        drawn, rest = near & fit.inliers, fit.scores[fit.inliers & ~near]
        pull = fit.scores[drawn].sum(axis=0)
        if pull @ np.linalg.lstsq(rest.T @ rest, pull, rcond=1e-14)[0] < CHI_SQUARE_99_OF_6:
            continue
        others = replace(matches, views=views.select(~near), probability=matches.probability[~near])
        far = localiser.fit_near(others, prediction)
        if far is None:
            continue
        step, common = se3_log(far.pose @ se3_inverse(fit.pose)), far.joint.common[-6:] - fit.joint.common[-6:]
        own = max(far.nis_before_scaling, 1.0) * far.clustering * far.relative
        squared = Prediction(fit.pose, own + common @ common.T).squared_departure(far.pose)
        if squared > most:
            most, doubts.spoils_keyframe = squared, bool(squared > CHI_SQUARE_95[6])
            doubts.spread = np.outer(step, step) + doubts.spoils_keyframe * own
        if squared <= CHI_SQUARE_9999_OF_6:
            continue
        by_fit, by_far = (seen_from(window, rows, each.pose) for each in (fit, far))
        drawn &= np.isfinite(by_far[:, 0])
        departure = views.measurement[:, :2] - by_far[:, :2]
        moves = np.flatnonzero(drawn & ~are_one_place(np.linalg.norm(departure, axis=1)))
        apart = np.linalg.norm((by_far - by_fit)[drawn, :2], axis=1)
        if len(moves) >= MIN_POINTS and not see_the_same(apart):
            doubts.spread, doubts.spoils_keyframe = np.zeros((6, 6)), False
            far = replace(far, inliers=_among(np.flatnonzero(~near)[far.inliers], len(rows)))
            return SecondMotion(far, fit.pose, own, moves, by_far[moves], departure[moves], True)
    return None


def _most_departing(cells: np.ndarray, others: np.ndarray, departs: np.ndarray) -> np.ndarray:
    """(M,) bool, those of `others` (K,) that depart from a pose, and as many that do not, which stand for most cells.

    `departs` (K,) are pixels from where the pose sees them; `cells` (M,) of the image are of all matches.
    """
    share = 1.0 / np.bincount(cells)[cells[others]]
    same = are_one_place(departs)
    return _among(others[np.lexsort((-share, same))[: 2 * (~same).sum()]], len(cells))


def _among(chosen: np.ndarray, count: int) -> np.ndarray:
    """(count,) bool of indices."""
    return np.bincount(chosen, minlength=count) > 0
