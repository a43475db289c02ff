"""Two maps of one place become one: keyframes of the second are found in the first, and all hang there."""

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sigmaslam.bounded_files import check_columns, load_arrays
from sigmaslam.errors import InputError
from sigmaslam.estimation.calibration_errors import CalibrationPrior
from sigmaslam.estimation.chi_square import CHI_SQUARE_9999_OF_6
from sigmaslam.estimation.estimator_graphs import EstimatorGraphs
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.marginalised_poses import step_between
from sigmaslam.frontend import build_frontend
from sigmaslam.geometry.calibration_sigmas import CalibrationSigmas
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import nearest_rigid, se3_inverse, se3_log, turn_covariance
from sigmaslam.progress import counted
from sigmaslam.slam.appearance import AppearanceIndex
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.keyframe import HangingKeyframe, Keyframe, from_origin
from sigmaslam.slam.map_file import MEND, TURN, pack_keyframes, read_keyframes
from sigmaslam.slam.measurement_noise import MeasurementNoise
from sigmaslam.slam.packed_view import PackedView
from sigmaslam.slam.place_recognition import retrieve
from sigmaslam.slam.point_map import PointMap, hand_over_points, merge_maps
from sigmaslam.slam.unguided_matching import UnguidedMatcher

# Of M points; one letter is one length.
_SHAPES: dict[str, tuple[str | int, ...]] = {
    **dict.fromkeys(("observations", "timestamps", "intensity"), ("M",)),
    **{"points": ("M", 3), "covariances": ("M", 3, 3), "pixels": ("M", 2), TURN: (4, 4)},
}
# Keyframes of the first map that look most like one of the second.
_CANDIDATES = 3


class MapFile:
    """What `sigmaslam track` left of a place: keyframes, their joint poses, points.

    Args:
        path: map.npz, or the run folder with it.
    Raises:
        InputError: there is no map with keyframes.
    """

    def __init__(self, path: Path) -> None:
        path = path / "map.npz" if path.is_dir() else path
        self.keyframes, self.past, self.hanging = read_keyframes(path)
        arrays = {TURN: np.eye(4), **load_arrays(path, MEND), **load_arrays(path, MEND, PointMap.__slots__)}
        check_columns(path, arrays, _SHAPES, {"observations": "iu"}, MEND)
        self.path, self.frontend, self.T_rectified_left = path, str(arrays["frontend"]), arrays[TURN]
        fx, fy, cx, cy, baseline, width, height = arrays["intrinsics"].tolist()
        self.camera = RectifiedStereo(fx, fy, cx, cy, baseline, round(width), round(height))
        self.points = PointMap(**{name: arrays[name] for name in PointMap.__slots__})

    @property
    def known(self) -> list[Keyframe | HangingKeyframe]:
        """All keyframes."""
        return [*self.keyframes, *self.hanging]

    def pose(self, keyframe: Keyframe | HangingKeyframe) -> np.ndarray:
        """(4, 4) in the world of the map."""
        return self.past.poses[keyframe.origin] @ keyframe.step

    def describe(self) -> str:
        """What it holds, a line each."""
        places = np.array([self.pose(each)[:3, 3] for each in self.known])
        extent = " x ".join(f"{side:.2f}" for side in np.ptp(places, axis=0))
        camera = self.camera
        return (
            f"{self.path}: {self.path.stat().st_size / 1e6:.1f} MB\n"
            f"keyframes  {len(self.known)} within {extent} m; {len(self.hanging)} of them placed by a neighbour\n"
            f"points     {len(self.points.points)}\n"
            f"front-end  {self.frontend}\n"
            f"camera     {camera.width}x{camera.height}, f {camera.fx:.1f} px, baseline {camera.baseline:.4f} m"
        )


def merge(one: MapFile, other: MapFile) -> dict[str, np.ndarray]:
    """Arrays of a map that holds both, in the world of the first.

    The second one hangs as a whole at the keyframe of the first that says best where it is.

    Raises:
        InputError: fewer than two keyframes of the other are found, or they contradict each other.
    """
    if other.frontend != one.frontend:
        raise InputError(f"{other.path}: made with the front-end {other.frontend}, not {one.frontend}")
    read_keyframes(other.path, one.frontend, one.camera)  # of the same camera, or it says so
    found, link = _find(one, other)
    covariance = link.covariance
    T_origin_other = link.T_key_camera @ se3_inverse(found.step)
    known = []
    for number, each in enumerate(other.known, start=len(one.known)):
        step, spread = step_between(other.past, found.origin, each.origin)
        spread = covariance + turn_covariance(
            T_origin_other, spread + found.covariance + turn_covariance(step, each.covariance)
        )
        packed = each.packed if isinstance(each, HangingKeyframe) else PackedView.of(each.view)
        T_origin_each = nearest_rigid(T_origin_other @ step @ each.step)
        known.append(HangingKeyframe(number, each.timestamp, packed, link.origin, T_origin_each, spread))
    T_one_origin = one.past.poses[link.origin]
    T_one_other = nearest_rigid(T_one_origin @ link.T_key_camera @ se3_inverse(other.pose(found)))
    # Points are in the worlds of the left cameras, keyframes in those of the rectified ones.
    T_left_one = se3_inverse(one.T_rectified_left)
    step = T_left_one @ T_one_other @ other.T_rectified_left
    spread = turn_covariance(T_left_one @ T_one_origin, covariance)
    merged = merge_maps([one.points, hand_over_points(other.points, step, spread)])
    arrays = {TURN: one.T_rectified_left, **{name: getattr(merged, name) for name in PointMap.__slots__}}
    return arrays | pack_keyframes(one.keyframes, one.past, one.frontend, one.camera, [*one.hanging, *known])


@dataclass(frozen=True)
class Link:
    """The pose T_key_camera (4, 4) of a keyframe of the other map at the keyframe `origin` of the first.

    Its covariance (6, 6) is perturbed from the left; so many matches agree.
    """

    origin: int
    T_key_camera: np.ndarray
    covariance: np.ndarray
    inliers: int


Found = tuple[Keyframe | HangingKeyframe, Link]


def _find(one: MapFile, other: MapFile) -> Found:
    """The keyframe of the other map that is found best, and where; another one agrees."""
    config = TrackerConfig()
    prior = CalibrationPrior.of(one.camera, CalibrationSigmas.none(), config.offset_sigma, config.estimate, None)
    window = KeyframeWindow(one.camera, prior, EstimatorGraphs(one.camera, "onnx", unscented=True))
    frontend = build_frontend(one.frontend, config.max_keypoints)
    matcher = UnguidedMatcher(one.camera, frontend, window, MeasurementNoise(config), config)
    appearance = AppearanceIndex()
    for each in one.known:
        appearance.add(each.id, each.descriptors)
    links = []
    with counted("keyframes", len(other.known)) as done:
        for each in other.known:
            view = each.view
            for candidate in retrieve(view, _CANDIDATES, one.known, appearance):
                relative = matcher.confirmed_pose_to(candidate.view, view)
                if relative is not None and matcher.is_beyond_chance(relative):
                    at = from_origin(candidate, relative)
                    spread = turn_covariance(at.T_key_camera, at.covariance)
                    links.append((each, Link(candidate.origin, at.T_key_camera, spread, int(at.inliers.sum()))))
                    break
            done()
    links.sort(key=lambda pair: -pair[1].inliers)
    for first, second in itertools.combinations(links, 2):
        if _agree(one, other, first, second):
            return first
    raise InputError(f"{other.path}: {len(links)} of {len(other.known)} keyframes are found, and two must agree")


def _agree(one: MapFile, other: MapFile, first: Found, second: Found) -> bool:
    """Whether two keyframes that were found lie to each other as their own map says."""
    (near, link), (far, check) = first, second
    T_one_other = one.past.poses[link.origin] @ link.T_key_camera @ se3_inverse(other.pose(near))
    found = one.past.poses[check.origin] @ check.T_key_camera
    departure = se3_log(found @ se3_inverse(T_one_other @ other.pose(far)))
    covariance = one.past.relative(link.origin)[check.origin]
    covariance = covariance + turn_covariance(T_one_other, other.past.relative(near.origin)[far.origin])
    for each in (link, check):
        covariance = covariance + turn_covariance(one.past.poses[each.origin], each.covariance)
    return bool(departure @ np.linalg.solve(covariance, departure) <= CHI_SQUARE_9999_OF_6)
