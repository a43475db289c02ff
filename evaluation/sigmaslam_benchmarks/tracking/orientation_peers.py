"""Relative orientation where it is hard: eight simulated cases and the fountain, beside OpenCV, PoseLib and COLMAP."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sigmaslam.frontend.image_pair import match_images
from sigmaslam.geometry.se3 import rotation_exp, rotation_log
from sigmaslam.two_view.relative_orientation import estimate_relative_orientation
from sigmaslam_benchmarks.matching.image_pairs import Motion
from sigmaslam_benchmarks.matching.sets import load_set

SEEDS = range(3000, 3040)
"""Used for nothing else."""
COUNT, SIGMA = 200, 0.5
_K = np.array([[520.0, 0.0, 310.0], [0.0, 500.0, 250.0], [0.0, 0.0, 1.0]])
_SIZE = (620, 500)
_SIDEWAYS, _FORWARD = np.array([-1.0, 0.1, 0.2]), np.array([0.05, -0.02, -1.0])
# An error above it counts as a failure, degrees.
_FAILED = 5.0
# Of the true cameras of the fountain: a few millimetres, and what that is at the distance of the targets, radians.
_TRUTH_METRES, _TRUTH_RADIANS = 0.003, np.radians(0.01)

Pose = tuple[np.ndarray, np.ndarray, np.ndarray | None]
"""R (3, 3), direction (3,), and covariance (6, 6) of both or None."""


@dataclass(frozen=True, slots=True)
class Case:
    """Motion, share of wrong matches, and whether the points are on a plane; one unit is an eighth of the depth."""

    translation: np.ndarray
    wrong: float
    plane: bool = False


CASES = {
    "sideways, 20 % wrong": Case(_SIDEWAYS, 0.2),
    "forward, 20 %": Case(_FORWARD, 0.2),
    "sideways, 50 %": Case(_SIDEWAYS, 0.5),
    "forward, 50 %": Case(_FORWARD, 0.5),
    "sideways, 70 %": Case(_SIDEWAYS, 0.7),
    "forward, 70 %": Case(_FORWARD, 0.7),
    "plane, 30 %": Case(_SIDEWAYS, 0.3, plane=True),
    "baseline 1/160 of the depth, 30 %": Case(0.05 * _SIDEWAYS, 0.3),
}


@dataclass(frozen=True, slots=True)
class PosePair:
    """Matches of two views with a known pose; covariance (M, 2, 2) as the estimators are told."""

    K: np.ndarray
    R: np.ndarray
    translation: np.ndarray
    points0: np.ndarray
    points1: np.ndarray
    probability: np.ndarray
    covariance: np.ndarray
    size: tuple[int, int]
    truth_covariance: np.ndarray

    @property
    def direction(self) -> np.ndarray:
        """(3,) of the translation, of length 1."""
        return np.asarray(self.translation / np.linalg.norm(self.translation))


def simulate(case: Case, seed: int) -> PosePair:
    """Points 4 to 12 units away, or on a plane 8 away, with noise in both images."""
    rng = np.random.default_rng(seed)
    R, depth = rotation_exp(rng.normal(0.0, 0.1, 3)), rng.uniform(4.0, 12.0, COUNT)
    slope = rng.uniform(-0.55, 0.55, (COUNT, 2))
    if case.plane:
        depth = 8.0 / (1.0 + slope @ (0.4, 0.3))
    points = np.c_[slope * depth[:, None], depth]
    seen = [each @ _K.T for each in (points, points @ R.T + case.translation)]
    pixels0, pixels1 = (each[:, :2] / each[:, 2:] + rng.normal(0.0, SIGMA, (COUNT, 2)) for each in seen)
    wrong = rng.random(COUNT) < case.wrong
    pixels1[wrong] = rng.uniform((0, 0), _SIZE, (int(wrong.sum()), 2))
    told = np.tile(2.0 * SIGMA**2 * np.eye(2), (COUNT, 1, 1))
    return PosePair(_K, R, case.translation, pixels0, pixels1, np.ones(COUNT), told, _SIZE, np.zeros((6, 6)))


def hard_cases(data: Path | None, note: Callable[[str], None]) -> dict[str, Any]:
    """What the page says of every case and the fountain, if the data are there, by every method that is installed."""
    sets: dict[str, Iterable[PosePair]] = {name: map(partial(simulate, case), SEEDS) for name, case in CASES.items()}
    if data is not None:
        sets["fountain, six pairs"] = _fountain(data)
    methods = _methods()
    rows = []
    for name, pairs in sets.items():
        errors: dict[str, list[tuple[float, float]]] = {method: [] for method in methods}
        nees: list[tuple[float, float]] = []
        for pair in pairs:
            for method, estimate in methods.items():
                pose = estimate(pair)
                errors[method].append((180.0, 180.0) if pose is None else _errors(pose, pair))
                if pose is not None and pose[2] is not None:
                    nees.append((_nees(pose, pair, pose[2]), _nees(pose, pair, pose[2] + pair.truth_covariance)))
        cells = [_cell(np.array(each)) for each in errors.values()]
        ratio, beside_truth = np.array(nees).T
        cell = f"{np.median(ratio):.2f}, {np.mean(ratio):.2f}"
        if name.startswith("fountain"):
            cell += f" (with the truth's error {np.median(beside_truth):.2f}, {np.mean(beside_truth):.2f})"
        rows.append([name, *cells, cell, _ahead(errors)])
        note(f"{name} done")
    return {
        "hard_rows": rows,
        "hard_methods": list(methods),
        "hard_matches": (COUNT, SIGMA),
        "hard_seeds": (SEEDS[0], SEEDS[-1]),
        "failed_degrees": f"{_FAILED:.0f}",
        "not_installed": [module for module in ("poselib", "pycolmap") if find_spec(module) is None],
    }


def _methods() -> dict[str, Callable[[PosePair], Pose | None]]:
    methods: dict[str, Callable[[PosePair], Pose | None]] = {
        "ours": _ours,
        "USAC_ACCURATE": partial(_usac, method=cv2.USAC_ACCURATE),
        "USAC_MAGSAC": partial(_usac, method=cv2.USAC_MAGSAC),
    }
    for name, module, estimate in (("PoseLib", "poselib", _poselib), ("COLMAP", "pycolmap", _colmap)):
        if find_spec(module) is not None:
            methods[name] = estimate
    return methods


def _ours(pair: PosePair) -> Pose | None:
    found = estimate_relative_orientation(pair.K, pair.points0, pair.points1, pair.probability, pair.covariance)
    return None if found is None else (found.R, found.direction, found.covariance)


def _usac(pair: PosePair, method: int) -> Pose | None:
    E, mask = cv2.findEssentialMat(pair.points0, pair.points1, pair.K, method, 0.9999, 1.0, 20_000)
    if np.shape(E) != (3, 3):
        return None
    _, R, t, _ = cv2.recoverPose(E, pair.points0, pair.points1, pair.K, mask=mask)
    return np.asarray(R), t.ravel(), None


def _camera(pair: PosePair) -> tuple[int, int, list[float]]:
    return *pair.size, [pair.K[0, 0], pair.K[1, 1], pair.K[0, 2], pair.K[1, 2]]


def _poselib(pair: PosePair) -> Pose | None:
    import poselib

    width, height, parameters = _camera(pair)
    camera = {"model": "PINHOLE", "width": width, "height": height, "params": parameters}
    options = {"max_epipolar_error": 1.0}
    pose, _ = poselib.estimate_relative_pose(pair.points0, pair.points1, camera, camera, options, {})
    t = np.asarray(pose.t)
    return np.asarray(pose.R), t / max(float(np.linalg.norm(t)), 1e-12), None


def _colmap(pair: PosePair) -> Pose | None:
    import pycolmap

    width, height, parameters = _camera(pair)
    camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=parameters)
    pycolmap.set_random_seed(0)
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose, options.ransac.max_error = True, 2.0
    index = np.tile(np.arange(len(pair.points0), dtype=np.uint32)[:, None], 2)
    found = pycolmap.estimate_calibrated_two_view_geometry(
        camera, pair.points0, camera, pair.points1, index, options
    ).cam2_from_cam1
    if found is None:
        return None
    return found.rotation.matrix(), found.translation / max(float(np.linalg.norm(found.translation)), 1e-12), None


def _fountain(data: Path) -> Iterable[PosePair]:
    for pair in load_set("fountain", data):
        assert isinstance(pair.truth, Motion)
        matches = match_images(pair.image0, pair.image1)
        T = pair.truth.T_1_0
        truth = np.diag([(_TRUTH_METRES / np.linalg.norm(T[:3, 3])) ** 2] * 3 + [_TRUTH_RADIANS**2] * 3)
        points = matches.keypoints0.astype(np.float64), matches.keypoints1.astype(np.float64)
        height, width = pair.image0.shape
        confidence = matches.probability, matches.covariance
        yield PosePair(pair.truth.K, T[:3, :3], T[:3, 3], *points, *confidence, (width, height), truth)


def _errors(pose: Pose, pair: PosePair) -> tuple[float, float]:
    """Of rotation and direction, degrees."""
    turn = np.linalg.norm(rotation_log(pair.R @ pose[0].T))
    return float(np.degrees(turn)), float(np.degrees(np.arccos(np.clip(pose[1] @ pair.direction, -1.0, 1.0))))


def _nees(pose: Pose, pair: PosePair, covariance: np.ndarray) -> float:
    """Per degree of freedom, of the angles of the direction and the rotation."""
    R, direction, _ = pose
    along = pair.direction - (direction @ pair.direction) * direction
    angle = np.arctan2(np.linalg.norm(along), direction @ pair.direction)
    error = np.r_[along * angle / max(float(np.linalg.norm(along)), 1e-15), rotation_log(pair.R @ R.T)]
    # The length of the direction is known.
    basis = np.zeros((6, 5))
    basis[:3, :2], basis[3:, 2:] = np.linalg.svd(direction[None])[2][1:].T, np.eye(3)
    error, covariance = basis.T @ error, basis.T @ covariance @ basis
    return float(error @ np.linalg.solve(covariance, error)) / 5.0


def _ahead(errors: dict[str, list[tuple[float, float]]]) -> str:
    """The methods whose median is below ours in all but 2.5 % of a thousand bootstraps over the pairs, and of what."""
    every = {method: np.array(each) for method, each in errors.items()}
    ours = every.pop("ours")
    drawn = np.random.default_rng(0).integers(0, len(ours), (1000, len(ours)))
    found = []
    for method, theirs in every.items():
        below = (np.median(theirs[drawn], axis=1) < np.median(ours[drawn], axis=1)).mean(axis=0) > 0.975
        found += [
            f"{method}'s {what}" for what, is_below in zip(("rotation", "direction"), below, strict=True) if is_below
        ]
    return ", ".join(found) or "none"


def _cell(errors: np.ndarray) -> str:
    rotation, direction = np.median(errors, axis=0)
    failed = int((errors.max(axis=1) > _FAILED).sum())
    return f"{rotation:.3f} / {direction:.3f} ({np.percentile(errors[:, 1], 90):.2f}), {failed}"
