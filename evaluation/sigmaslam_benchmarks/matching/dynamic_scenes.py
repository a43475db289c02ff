"""Rendered pairs of views in which half of the right matches are on things that move: who accepts what."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from sigmaslam.frontend.image_pair import match_features
from sigmaslam.frontend.match_confidence import ConfidenceEstimator
from sigmaslam.frontend.types import Features
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import rotation_log
from sigmaslam.two_view.epipolar import estimate_epipolar_pose
from sigmaslam.two_view.stereo_pose import estimate_relative_pose
from sigmaslam_evaluation.metrics.probability_calibration import RIGHT
from sigmaslam_synthetic.rendering.visibility import move
from sigmaslam_synthetic.scene_pairs import ScenePair, ScenePairs
from sigmaslam_synthetic.truth import at_pixels

SHARES = (0.35, 0.5)
"""Between these are the shares of right matches on moving things: beyond a half the scene may be the lesser body."""
_SIZE = 384
_DOMAINS = ("street", "room", "drone")
# Image motion below this, in pixels, does not count as independent motion.
_MOVED = 3.0
_MIN_MATCHES = 60
# Baseline of the virtual stereo pair, in median depths, and noise of its disparities, in pixels.
_BASELINE, _DISPARITY_NOISE = 0.05, 0.3


@dataclass(frozen=True, slots=True)
class MoverJudgement:
    """Over all pairs found.

    Attributes:
        pairs: how many.
        moving: share of the right matches on moving things.
        static_matched: share on the static scene of the matches more probable than not, wrong ones counted as not.
        static_epipolar: of those that agree with the pose from two images.
        static_stereo: of those that agree with the pose from stereo points, as the tracker starts.
        poses_right: share of the pairs whose pose from stereo points turns by less than 1 degree wrongly.
    """

    pairs: int
    moving: float
    static_matched: float
    static_epipolar: float
    static_stereo: float
    poses_right: float


def judge_movers(
    detect: Callable[[np.ndarray], Features], judge: ConfidenceEstimator, seed: int, tried: int
) -> MoverJudgement:
    """Looks for such pairs among `tried` rendered ones and matches them.

    Args:
        seed: of the pairs.
        tried: how many are rendered.
    """
    stream = ScenePairs(seed, _SIZE, _DOMAINS, max_moving_share=0.5)
    counts = np.zeros((4, 2))
    pair_count, right_poses = 0, 0
    for index in range(tried):
        pair = stream.pair(index)
        image0, image1 = (np.round(255.0 * image).astype(np.uint8) for image in (pair.image0, pair.image1))
        features0, features1 = detect(image0), detect(image1)
        matches = match_features(judge, image0, image1, features0, features1)
        truth = _look_up(pair, matches.keypoints0.astype(np.float64))
        right = np.linalg.norm(matches.keypoints1 - truth.places, axis=1) < RIGHT
        static = right & ~truth.moved
        share = 1.0 - static.sum() / max(right.sum(), 1)
        if right.sum() < _MIN_MATCHES or not SHARES[0] <= share <= SHARES[1]:
            continue
        pair_count += 1
        camera0, camera1 = pair.views0.sight.eye.camera, pair.views1.sight.eye.camera
        # Map both views to the intrinsics of the first camera; the principal points are equal.
        centre, zoom = np.array([camera0.cx, camera0.cy]), camera0.fx / camera1.fx
        points1 = (matches.keypoints1 - centre) * zoom + centre
        covariance = zoom**2 * matches.covariance
        camera = RectifiedStereo(
            camera0.fx, camera0.fy, camera0.cx, camera0.cy, _BASELINE * float(np.median(truth.depth0)), _SIZE, _SIZE
        )
        epipolar = estimate_epipolar_pose(camera.matrix, matches.keypoints0, points1, matches.probability, covariance)
        disturbance = np.random.default_rng((seed, index)).normal(0.0, _DISPARITY_NOISE, (2, len(truth.depth0)))
        landmarks = np.column_stack([matches.keypoints0, camera.fx * camera.baseline / truth.depth0 + disturbance[0]])
        depth1 = np.where(truth.depth1 > 0, truth.depth1, np.nan)
        measurement = np.column_stack([points1, camera.fx * camera.baseline / depth1 + disturbance[1]])
        sigma = np.tile([0.1, 0.1, _DISPARITY_NOISE], (len(landmarks), 1))
        noise = np.tile(_DISPARITY_NOISE**2 * np.eye(3), (len(landmarks), 1, 1))
        noise[:, :2, :2] = covariance
        stereo = estimate_relative_pose(camera, landmarks, sigma, measurement, noise, matches.probability)
        accepted = [
            right,
            np.ones(len(right), bool),
            np.zeros(len(right), bool) if epipolar is None else epipolar.inliers,
            np.zeros(len(right), bool) if stereo is None else stereo.inliers,
        ]
        counts += [[float((each & static).sum()), float(each.sum())] for each in accepted]
        if stereo is not None:
            turn = rotation_log(stereo.T_key_camera[:3, :3] @ truth.T_1_0[:3, :3])
            right_poses += bool(np.degrees(np.linalg.norm(turn)) < 1.0)
    still, matched, epipolar_share, stereo_share = (
        float(share) for share in counts[:, 0] / np.maximum(counts[:, 1], 1.0)
    )
    return MoverJudgement(
        pair_count, 1.0 - still, matched, epipolar_share, stereo_share, right_poses / max(pair_count, 1)
    )


@dataclass(frozen=True, slots=True)
class _TrueMotion:
    """Of M pixels of the first view: where they are in the second, whether they moved on their own, depths, motion."""

    places: np.ndarray
    moved: np.ndarray
    depth0: np.ndarray
    depth1: np.ndarray
    T_1_0: np.ndarray


def _look_up(pair: ScenePair, points0: np.ndarray) -> _TrueMotion:
    sight0, sight1 = pair.views0.sight, pair.views1.sight
    T_1_0 = sight1.T_view_mover[0, 0] @ torch.linalg.inv(sight0.T_view_mover[0, 0])
    places, visible = pair.transfer(points0)
    view = torch.zeros(len(points0), dtype=torch.int64)
    facet, grid = at_pixels(pair.views0, view, torch.from_numpy(points0.T.copy()))
    hit = facet >= 0
    mover = sight0.surfaces.mover.index_select(0, facet[hit])
    points = sight0.points(view[hit], facet[hit], grid[:, hit])
    in_view0 = move(sight0.T_view_mover, view[hit], mover, points)
    in_view1 = move(sight1.T_view_mover, view[hit], mover, points)
    still = T_1_0[:3, :3] @ in_view0 + T_1_0[:3, 3:]
    static_places = sight1.eye.project(torch.where(still[2] > 0, still, torch.ones_like(still)))[0].T.numpy()
    rows = hit.numpy()
    moved, depth0, depth1 = np.zeros(len(points0), bool), np.ones(len(points0)), np.ones(len(points0))
    moved[rows] = np.linalg.norm(static_places - places[rows], axis=1) > _MOVED
    depth0[rows], depth1[rows] = in_view0[2].numpy(), in_view1[2].numpy()
    return _TrueMotion(np.where(visible[:, None], places, np.inf), moved, depth0, depth1, T_1_0.numpy())
