"""The page of two-view geometry: ours beside OpenCV's on simulated matches, and what covariances are worth."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import rotation_exp, rotation_log
from sigmaslam.geometry.uncertainty import propagate
from sigmaslam.two_view.absolute_orientation import absolute_orientation
from sigmaslam.two_view.fundamental import FundamentalMatrix, epipolar_lines, estimate_fundamental
from sigmaslam.two_view.relative_orientation import estimate_relative_orientation
from sigmaslam.two_view.triangulation import METHODS, TwoViews, triangulate, triangulate_optimal
from sigmaslam_benchmarks.tracking.orientation_peers import hard_cases
from sigmaslam_benchmarks.tracking.page import fill_page, write_page

SEEDS = range(1000, 1040)
"""Used for nothing else."""
_K = np.array([[520.0, 0.0, 310.0], [0.0, 500.0, 250.0], [0.0, 0.0, 1.0]])
_SIGMA, _COUNT, _WRONG = 0.5, 150, 0.2
_CAMERA, _DEPTHS = RectifiedStereo(500.0, 500.0, 320.0, 240.0, 0.12, 640, 480), np.geomspace(0.5, 20.0, 9)
_MOTIONS = {"sideways": (-1.0, 0.1, 0.2), "forward": (0.05, -0.02, -1.0)}


@dataclass(frozen=True, slots=True)
class _Matches:
    """Views, points (M, 3), pixels (M, 4) with noise, and which of them are wrong."""

    views: TwoViews
    points: np.ndarray
    pixels: np.ndarray
    wrong: np.ndarray


def write_geometry(
    path: Path, command: str, data: Path | None = None, note: Callable[[str], None] = lambda text: None
) -> str:
    """Writes the page and returns it; notes in it are kept. Without the folder `data`, without photographs."""
    tables: dict[str, list[list[str]]] = {}
    for part in (_fundamental, _relative, _absolute, _triangulation, _depth):
        name = part.__name__.strip("_")
        tables[name] = list(part())
        note(f"{name} done")
    page = fill_page(
        "geometry",
        command,
        **tables,
        **hard_cases(data, note),
        seeds=(SEEDS[0], SEEDS[-1]),
        count=_COUNT,
        sigma=_SIGMA,
        wrong=f"{100 * _WRONG:.0f}",
        motions=list(_MOTIONS),
        slope=f"{_depth_slope():.4f}",
    )
    return write_page(path, page)


def _draw(seed: int, motion: str, wrong: float = _WRONG) -> _Matches:
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_exp(rng.normal(0.0, 0.1, 3)), _MOTIONS[motion]
    views = TwoViews(_K, _K, T)
    depth = rng.uniform(4.0, 12.0, _COUNT)
    points = np.column_stack([rng.uniform(-0.55, 0.55, (_COUNT, 2)) * depth[:, None], depth])
    pixels = views.project(points) + rng.normal(0.0, _SIGMA, (_COUNT, 4))
    bad = rng.random(_COUNT) < wrong
    pixels[bad, 2:] = rng.uniform((0, 0), (620, 500), (int(bad.sum()), 2))
    return _Matches(views, points, pixels, bad)


def fundamental_by_eight(points0: np.ndarray, points1: np.ndarray) -> np.ndarray:
    """F (3, 3) of the normalised 8-point method, from eight matches (M, 2) or more.

    Raises:
        ValueError: there are fewer, or they are degenerate.
    """
    if len(points0) != len(points1) or len(points0) < 8:
        raise ValueError(f"8 matches are needed, got {len(points0)} and {len(points1)} points")
    F, _ = cv2.findFundamentalMat(points0.astype(np.float64), points1.astype(np.float64), cv2.FM_8POINT)
    if np.shape(F) != (3, 3):
        raise ValueError(f"the {len(points0)} matches allow more than one fundamental matrix")
    return np.asarray(F / np.linalg.norm(F))


def _fundamental() -> Iterator[list[str]]:
    """Distances of exact points from the epipolar lines of F."""
    methods: dict[str, Callable[[_Matches], np.ndarray]] = {
        "ours": lambda m: _ours_f(m).F,
        "OpenCV USAC_ACCURATE": lambda m: _opencv_f(m, cv2.USAC_ACCURATE),
        "OpenCV USAC_MAGSAC": lambda m: _opencv_f(m, cv2.USAC_MAGSAC),
        "OpenCV RANSAC": lambda m: _opencv_f(m, cv2.FM_RANSAC),
        "OpenCV LMEDS": lambda m: _opencv_f(m, cv2.FM_LMEDS),
        "8 points, right matches alone": lambda m: fundamental_by_eight(m.pixels[~m.wrong, :2], m.pixels[~m.wrong, 2:]),
    }
    for name, method in methods.items():
        cells = [_spread(_line_distance(method(m), m) for m in _all(motion)) for motion in _MOTIONS]
        nees = [_nees_f(motion) if name == "ours" else "" for motion in _MOTIONS]
        yield [name, *cells, *nees]


def _relative() -> Iterator[list[str]]:
    """Errors of rotation and direction."""
    methods = {"ours": None, "OpenCV USAC_ACCURATE": cv2.USAC_ACCURATE, "OpenCV RANSAC (5 points)": cv2.RANSAC}
    for name, flag in methods.items():
        cells, nees = [], []
        for motion in _MOTIONS:
            errors = []
            for m in _all(motion):
                R, direction, covariance = _ours_pose(m) if flag is None else _opencv_pose(m, flag)
                true = m.views.T_1_0[:3, 3] / np.linalg.norm(m.views.T_1_0[:3, 3])
                turn = rotation_log(m.views.T_1_0[:3, :3] @ R.T)
                angle = np.arccos(np.clip(true @ direction, -1.0, 1.0))
                errors.append(np.degrees((np.linalg.norm(turn), angle)))
                if covariance is not None:
                    nees.append(_nees(np.r_[true - direction, turn], covariance, 5))
            cells += [_spread(np.array(errors)[:, k]) for k in (0, 1)]
        yield [name, *cells, f"{np.median(nees):.2f}" if nees else ""]


def _absolute() -> Iterator[list[str]]:
    """Errors of a rigid motion from control points of unlike weight."""
    ours: dict[bool, list[tuple[float, float]]] = {False: [], True: []}
    plain: dict[bool, list[float]] = {False: [], True: []}
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        source, R, t = rng.normal(0.0, 3.0, (25, 3)), rotation_exp(rng.normal(0.0, 1.0, 3)), rng.normal(0.0, 5.0, 3)
        sigma = np.geomspace(0.02, 0.2, 25)
        for similar in ours:
            scale = 1.3 if similar else 1.0
            target = scale * source @ R.T + t + sigma[:, None] * rng.standard_normal((25, 3))
            found = absolute_orientation(source, target, sigma**-2.0, similar, 1.0)
            centroid = sigma**-2.0 @ source / (sigma**-2.0).sum()
            turn = rotation_log(R @ found.R.T)
            error = np.r_[scale * R @ centroid + t - found.apply(centroid), turn, np.log(scale / found.scale)]
            size = len(found.covariance)
            ours[similar].append((float(np.degrees(np.linalg.norm(turn))), _nees(error[:size], found.covariance, size)))
            # OpenCV's Umeyama knows no weights.
            affine, _ = cv2.estimateAffine3D(source, target, force_rotation=True)
            their = affine[:, :3] / np.cbrt(np.linalg.det(affine[:, :3]))
            plain[similar].append(float(np.degrees(np.linalg.norm(rotation_log(R @ their.T)))))
    found_nees = [f"{np.median([nees for _, nees in ours[each]]):.2f}" for each in ours]
    yield ["ours", *(_spread([angle for angle, _ in ours[each]]) for each in ours), *found_nees]
    yield ["OpenCV estimateAffine3D (no weights)", *(_spread(plain[each]) for each in ours), "", ""]


def _triangulation() -> Iterator[list[str]]:
    """Errors of points from right matches and the true pose."""
    noise = _SIGMA**2 * np.eye(4)
    for name in (*(method for method in METHODS if method != "parallel"), "Hartley and Sturm (OpenCV)"):
        cells, nees = [], []
        for motion in _MOTIONS:
            errors, squared = [], []
            for seed in SEEDS:
                m = _draw(seed, motion, 0.0)
                if name in METHODS:
                    found, covariance = triangulate(m.views, m.pixels, noise, name)
                else:
                    pairs = cv2.correctMatches(m.views.fundamental, m.pixels[None, :, :2], m.pixels[None, :, 2:])
                    found = triangulate_optimal(m.views, np.concatenate([each[0] for each in pairs], axis=1))
                    covariance = np.full((*found.shape, 3), np.nan)
                # Points that noise puts at infinity are left out alike for all.
                known = (m.points[:, 2] > 0) & np.isfinite(found).all(axis=1) & _has_parallax(m)
                error = (found - m.points)[known]
                errors.append(100.0 * np.sqrt(((error**2).sum(axis=1) / (m.points[known] ** 2).sum(axis=1)).mean()))
                squared.append(
                    np.median([e @ np.linalg.solve(C, e) / 3 for e, C in zip(error, covariance[known], strict=True)])
                )
            cells.append(_spread(errors))
            nees.append("" if not np.isfinite(squared).all() else f"{np.mean(squared):.2f}")
        yield [name, *cells, *nees]


def _depth() -> Iterator[list[str]]:
    """Error of the depth of a stereo point, first and second order beside Monte Carlo."""
    for number, z in enumerate(_DEPTHS):
        uvd, sigma = _stereo_point(z)
        draws = _CAMERA.triangulate(uvd + sigma * np.random.default_rng(1000 + number).standard_normal((200_000, 3)))
        (mean, first), (moved, second) = (
            propagate(_CAMERA.triangulate, uvd, np.diag(sigma**2), order) for order in (1, 2)
        )
        by_rule = z * z / _CAMERA.focal_baseline * sigma[2]
        figures = (by_rule, np.sqrt(first[2, 2]), np.sqrt(second[2, 2]), draws[:, 2].std())
        bias = ((moved - mean)[2], draws[:, 2].mean() - mean[2])
        yield [f"{z:.2f}", *(f"{1e3 * each:.2f}" for each in (*figures, *bias))]


def _depth_slope() -> float:
    """Of log sigma_Z against log Z, to first order."""
    sigmas = []
    for z in _DEPTHS:
        uvd, sigma = _stereo_point(z)
        sigmas.append(np.sqrt(propagate(_CAMERA.triangulate, uvd, np.diag(sigma**2), 1)[1][2, 2]))
    return float(np.polyfit(np.log(_DEPTHS), np.log(sigmas), 1)[0])


def _stereo_point(depth: float) -> tuple[np.ndarray, np.ndarray]:
    """(u, v, disparity) of a point at a depth, metres, and their sigmas, pixels."""
    return np.array([400.0, 300.0, _CAMERA.focal_baseline / depth]), np.array([0.2, 0.2, 0.2])


def _all(motion: str) -> Iterable[_Matches]:
    return (_draw(seed, motion) for seed in SEEDS)


def _ours_f(m: _Matches) -> FundamentalMatrix:
    noise = np.tile(_SIGMA**2 * np.eye(2), (_COUNT, 1, 1))
    found = estimate_fundamental(m.pixels[:, :2], m.pixels[:, 2:], np.ones(_COUNT), noise, _SIGMA)
    assert found is not None
    return found


def _opencv_f(m: _Matches, method: int) -> np.ndarray:
    return np.asarray(cv2.findFundamentalMat(m.pixels[:, :2], m.pixels[:, 2:], method, 1.5, 0.999, 2000)[0])


def _ours_pose(m: _Matches) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    noise = np.tile(2.0 * _SIGMA**2 * np.eye(2), (_COUNT, 1, 1))
    found = estimate_relative_orientation(_K, m.pixels[:, :2], m.pixels[:, 2:], np.ones(_COUNT), noise)
    assert found is not None
    return found.R, found.direction, found.covariance


def _opencv_pose(m: _Matches, method: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    E, mask = cv2.findEssentialMat(m.pixels[:, :2], m.pixels[:, 2:], _K, method, 0.999, 1.5, 2000)
    _, R, t, _ = cv2.recoverPose(E[:3], m.pixels[:, :2], m.pixels[:, 2:], _K, mask=mask)
    return np.asarray(R), t.ravel(), None


def _line_distance(F: np.ndarray, m: _Matches) -> float:
    exact = m.views.project(m.points)
    one, other = (np.column_stack([exact[:, k : k + 2], np.ones(_COUNT)]) for k in (0, 2))
    there, back = epipolar_lines(F, exact[:, :2]) * other, epipolar_lines(F.T, exact[:, 2:]) * one
    return float(np.sqrt((there.sum(axis=1) ** 2 + back.sum(axis=1) ** 2).mean() / 2.0))


def _nees_f(motion: str) -> str:
    squared = []
    for m in _all(motion):
        found = _ours_f(m)
        true = m.views.fundamental.ravel() / np.linalg.norm(m.views.fundamental)
        error = true * np.sign(true @ found.F.ravel()) - found.F.ravel()
        squared.append(_nees(error, found.covariance, 7))
    return f"{np.median(squared):.2f}"


def _nees(error: np.ndarray, covariance: np.ndarray, freedom: int) -> float:
    """Per degree of freedom, in the subspace that the covariance has."""
    values, vectors = np.linalg.eigh(covariance)
    return float(((vectors[:, -freedom:].T @ error) ** 2 / values[-freedom:]).sum() / freedom)


def _has_parallax(m: _Matches) -> np.ndarray:
    """(M,) bool, the point is 4 px from where it would be at infinity."""
    exact = m.views.project(m.points)
    far = m.views.project(1e9 * m.points)
    return np.asarray(np.linalg.norm((exact - far)[:, 2:], axis=1) > 4.0)


def _spread(values: Iterable[float]) -> str:
    low, middle, high = np.percentile(list(values), (25, 50, 75))
    return f"{middle:.3g} ({low:.3g} - {high:.3g})"
