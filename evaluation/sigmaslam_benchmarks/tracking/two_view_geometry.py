"""The page of two-view geometry: ours beside OpenCV's on simulated matches, and what covariances are worth."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import rotation_exp, rotation_log
from sigmaslam.geometry.uncertainty import propagate
from sigmaslam.two_view.absolute_orientation import absolute_orientation
from sigmaslam.two_view.fundamental import FundamentalMatrix, epipolar_lines, estimate_fundamental, fundamental_by_eight
from sigmaslam.two_view.relative_orientation import estimate_relative_orientation
from sigmaslam.two_view.triangulation import METHODS, TwoViews, triangulate, triangulate_optimal
from sigmaslam_benchmarks.tracking.orientation_peers import orientation_table
from sigmaslam_benchmarks.tracking.page import header, opening, row, write_page

SEEDS = range(1000, 1040)
"""Used for nothing else."""
_K = np.array([[520.0, 0.0, 310.0], [0.0, 500.0, 250.0], [0.0, 0.0, 1.0]])
_SIGMA, _COUNT, _WRONG = 0.5, 150, 0.2
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
    lines = opening(
        "Two-view geometry",
        command,
        f". Simulated matches, seeds {SEEDS[0]} to {SEEDS[-1]}: {_COUNT}",
    )
    lines += [
        f"points 4 to 12 baselines away, {_SIGMA} px of noise in each coordinate, {100 * _WRONG:.0f} % of wrong",
        "matches in the first two tables, which the estimators are not told. Medians over the seeds, quartiles in",
        "brackets. NEES is per degree of freedom, and its median.",
        "",
    ]
    for part in (_fundamental, _relative, _absolute, _triangulation, _depth):
        lines += [*part(), ""]
        note(f"{part.__name__.strip('_')} done")
    lines += [*orientation_table(data, note), ""]
    return write_page(path, "\n".join(lines))


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


def _fundamental() -> list[str]:
    """Distances of exact points from the epipolar lines of F."""
    methods: dict[str, Callable[[_Matches], np.ndarray]] = {
        "ours": lambda m: _ours_f(m).F,
        "OpenCV USAC_ACCURATE": lambda m: _opencv_f(m, cv2.USAC_ACCURATE),
        "OpenCV USAC_MAGSAC": lambda m: _opencv_f(m, cv2.USAC_MAGSAC),
        "OpenCV RANSAC": lambda m: _opencv_f(m, cv2.FM_RANSAC),
        "OpenCV LMEDS": lambda m: _opencv_f(m, cv2.FM_LMEDS),
        "8 points, right matches alone": lambda m: fundamental_by_eight(m.pixels[~m.wrong, :2], m.pixels[~m.wrong, 2:]),
    }
    lines = [
        "## Fundamental matrix",
        "",
        "RMS distance of exact points from their epipolar lines, pixels. NEES of 7 degrees of freedom: 0.91 is right.",
        "",
    ]
    lines += header("method", *_MOTIONS, "NEES, sideways", "NEES, forward", numbers_from=1)
    for name, method in methods.items():
        cells = [_spread(_line_distance(method(m), m) for m in _all(motion)) for motion in _MOTIONS]
        nees = [_nees_f(motion) if name == "ours" else "" for motion in _MOTIONS]
        lines.append(row(name, *cells, *nees))
    return lines


def _relative() -> list[str]:
    """Errors of rotation and direction."""
    lines = [
        "## Relative orientation",
        "",
        "Errors of rotation and of direction, degrees. NEES of 5 degrees of freedom: 0.87 is right.",
        "",
    ]
    lines += header(
        "method",
        *(f"{motion}: {what}" for motion in _MOTIONS for what in ("rotation", "direction")),
        "NEES",
        numbers_from=1,
    )
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
        lines.append(row(name, *cells, f"{np.median(nees):.2f}" if nees else ""))
    return lines


def _absolute() -> list[str]:
    """Errors of a rigid motion from control points of unlike weight."""
    lines = [
        "## Absolute orientation",
        "",
        "From 25 control points whose sigmas go from 0.02 to 0.2 m: error of the rotation, degrees.",
        "",
    ]
    lines += header("method", "rigid", "similarity", "NEES, rigid", "NEES, similarity", numbers_from=1)
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
    lines.append(row("ours", *(_spread([angle for angle, _ in ours[each]]) for each in ours), *found_nees))
    lines.append(row("OpenCV estimateAffine3D (no weights)", *(_spread(plain[each]) for each in ours), "", ""))
    return lines


def _triangulation() -> list[str]:
    """Errors of points from right matches and the true pose."""
    lines = [
        "## Triangulation",
        "",
        "RMS error of points over their distance, per cent, right matches and the true pose.",
        "",
    ]
    lines += header("method", *_MOTIONS, *(f"NEES, {motion}" for motion in _MOTIONS), numbers_from=1)
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
        lines.append(row(name, *cells, *nees))
    lines += [
        "",
        "NEES here is the median over points; 0.79 is right. Points with less than 4 px of parallax are left out.",
    ]
    return lines


def _depth() -> list[str]:
    """Slope of the error of depth, first and second order beside Monte Carlo."""
    camera = RectifiedStereo(500.0, 500.0, 320.0, 240.0, 0.12, 640, 480)
    depth = np.geomspace(0.5, 20.0, 9)
    lines = ["## Depth of a stereo point", ""]
    lines += [
        "Parallel stereo, f = 500 px, baseline 0.12 m, 0.2 px of noise: sigma of depth by (9.35), (9.36) and by",
        "200,000 draws; bias of the depth to second order.",
        "",
    ]
    lines += header(
        "depth m",
        "(9.36) mm",
        "first order mm",
        "second order mm",
        "drawn mm",
        "bias, second order mm",
        "bias, drawn mm",
        numbers_from=0,
    )
    found = []
    for number, z in enumerate(depth):
        uvd, sigma = np.array([400.0, 300.0, camera.focal_baseline / z]), np.array([0.2, 0.2, 0.2])
        draws = camera.triangulate(uvd + sigma * np.random.default_rng(1000 + number).standard_normal((200_000, 3)))
        (mean, first), (moved, second) = (
            propagate(camera.triangulate, uvd, np.diag(sigma**2), order) for order in (1, 2)
        )
        found.append(np.sqrt(first[2, 2]))
        figures = (z * z / camera.focal_baseline * 0.2, found[-1], np.sqrt(second[2, 2]), draws[:, 2].std())
        bias = ((moved - mean)[2], draws[:, 2].mean() - mean[2])
        lines.append(row(f"{z:.2f}", *(f"{1e3 * each:.2f}" for each in (*figures, *bias))))
    slope = np.polyfit(np.log(depth), np.log(found), 1)[0]
    return [*lines, "", f"Slope of log sigma_Z against log Z: {slope:.4f} (2 by 9.36)."]


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
