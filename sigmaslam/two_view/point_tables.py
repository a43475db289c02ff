"""Triangulation (9.34) and absolute orientation (9.2.3.3) from files to files."""

import csv
import io
from pathlib import Path

import numpy as np

from sigmaslam.bounded_files import TABLE_BYTES, load_columns, read_text, shorten
from sigmaslam.errors import InputError
from sigmaslam.files import atomic_write_json, atomic_write_text, csv_text
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.geometry.se3 import rigid_motion, se3_inverse, transform_points
from sigmaslam.geometry.uncertainty import propagate
from sigmaslam.two_view.absolute_orientation import absolute_orientation
from sigmaslam.two_view.triangulation import TwoViews, triangulate

_PIXELS = ("u0", "v0", "u1", "v1")
_PLACE = ("x", "y", "z")
# Pixels; good calibrations leave less than one.
_MOST_MISSED = 3.0
# Of the distance of control points from their mean: survey errors are far smaller.
_MOST_OF_SPREAD = 0.1
_COVARIANCE = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")


def triangulate_file(source: Path, camera: StereoCamera, out: Path, method: str, sigma: float) -> str:
    """Points of a stereo pair, in the left camera, with their covariance (9.35); says in words what was written.

    Args:
        source: CSV with a header: u0,v0,u1,v1, pixels of the raw left and right image, and if wanted `id` and `sigma`;
            or an .npz of `sigmaslam images match`, left image first, whose covariance of right pixels is taken.
        out: CSV to write: id,x,y,z in metres and the upper triangle of the covariance.
        method: of `two_view.triangulation.METHODS`; parallel rectifies the pixels.
        sigma: of a coordinate, pixels, where the file does not say.

    Raises:
        InputError: a file has other columns, or no pair of pixels meets in front of the cameras.
    """
    names, pixels, covariance = _read_pairs(source, sigma)
    points, spread = triangulate_pairs(camera, pixels, covariance, method)
    usable = np.isfinite(points).all(axis=1) & np.isfinite(spread).all(axis=(1, 2)) & (points[:, 2] > 0.0)
    if not usable.any():
        raise InputError(
            f"{source}: none of {len(usable)} pairs meets in front of the cameras: is the left image first?"
        )
    upper = spread[:, *np.triu_indices(3)]
    rows = [
        [name, *(f"{value:.9g}" for value in (*point, *cells))]
        for name, point, cells, used in zip(names, points.tolist(), upper.tolist(), usable.tolist(), strict=True)
        if used
    ]
    atomic_write_text(out, csv_text([["id", *_PLACE, *_COVARIANCE], *rows]))
    depth, sigma_depth = points[usable, 2], np.sqrt(spread[usable, 2, 2])
    missed = int((_misses(camera, points[usable], pixels[usable]) > _MOST_MISSED).sum())
    warning = (
        f"{missed} of the pairs miss each other by more than {_MOST_MISSED:g} px, or lie outside of the images: "
        "do they belong together?\n"
    )
    return (warning if missed else "") + (
        f"{len(rows)} points, {len(usable) - len(rows)} left out that meet nowhere before the cameras; "
        f"depth {np.median(depth):.4g} ± {np.median(sigma_depth):.2g} m in the median\nWritten: {out}"
    )


def _misses(camera: StereoCamera, points: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(N,) pixels between (N, 4), of which points (N, 3) are made, and where these are seen; infinite outside."""
    T = se3_inverse(camera.T_left_right)
    seen = camera.left.project(points), camera.right.project(transform_points(T, points))
    ways = np.linalg.norm(np.stack(seen, axis=1) - pixels.reshape(-1, 2, 2), axis=2).max(axis=1)
    sizes = [size for eye in (camera.left, camera.right) for size in (eye.width, eye.height)]
    return np.where(((pixels > -1.0) & (pixels < sizes)).all(axis=1) & np.isfinite(ways), ways, np.inf)


def triangulate_pairs(
    camera: StereoCamera, pixels: np.ndarray, covariance: np.ndarray, method: str
) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) in the left camera with covariances (N, 3, 3); NaN where a pixel has no ray or no point.

    Args:
        pixels: (N, 4) of raw images.
        covariance: (N, 4, 4) of them.
        method: of `two_view.triangulation.METHODS`.
    """
    views, R_view_left, R_view_right = _views(camera, method == "parallel")

    def straighten(raw: np.ndarray) -> np.ndarray:
        """Pixels of cameras without distortion; for `parallel` those of the rectified ones."""
        left = camera.left.unproject(raw[..., :2]) @ R_view_left.T @ views.K0.T
        right = camera.right.unproject(raw[..., 2:]) @ R_view_right.T @ views.K1.T
        return np.concatenate([left[..., :2] / left[..., 2:], right[..., :2] / right[..., 2:]], axis=-1)

    straight, spread = propagate(straighten, pixels, covariance)
    usable = np.isfinite(straight).all(axis=1) & np.isfinite(spread).all(axis=(1, 2))
    if method == "parallel":
        # Differences are taken over a thousandth of sigma, beyond which a disparity must stay positive.
        usable &= straight[:, 0] - straight[:, 2] > 0.01 * np.sqrt(np.maximum(spread[:, 0, 0], spread[:, 2, 2]))
    points, found = np.full((len(pixels), 3), np.nan), np.full((len(pixels), 3, 3), np.nan)
    if usable.any():
        points[usable], found[usable] = triangulate(views, straight[usable], spread[usable], method)
    return points @ R_view_left, R_view_left.T @ found @ R_view_left


def _views(camera: StereoCamera, rectified: bool) -> tuple[TwoViews, np.ndarray, np.ndarray]:
    """Pinhole cameras in place of the pair's, and the rotations from the pair's into them."""
    if not rectified:
        return TwoViews(camera.left.matrix, camera.right.matrix, se3_inverse(camera.T_left_right)), np.eye(3), np.eye(3)
    rectifier = StereoRectifier(camera)
    K, T_right_left = rectifier.rectified.matrix, rigid_motion(np.eye(3), [-rectifier.rectified.baseline, 0.0, 0.0])
    return TwoViews(K, K, T_right_left), rectifier.R_rectified_left, rectifier.R_rectified_right


def orient_files(source: Path, target: Path, out: Path, with_scale: bool, sigma: float | None) -> str:
    """Rotation, translation and scale from a frame into another by control points; says them in words.

    Args:
        source, target: CSV with a header: id,x,y,z; in the target, if wanted, `sigma` in metres. Points of one id
            belong together; others are left out.
        out: JSON to write: T_target_source (with the scale in its rotation), scale, covariance.
        with_scale: a similarity.
        sigma: of a coordinate of the target points, metres, where the file does not say; None: from the residuals.

    Raises:
        InputError: a file has other columns, or fewer than three points are in both.
    """
    first, second = (_read_points(path) for path in (source, target))
    names = [name for name in first if name in second]
    if len(names) < 3:
        raise InputError(f"{source} and {target} have {len(names)} ids in common: give three points or more in both")
    points, control = (np.array([each[name][:3] for name in names]) for each in (first, second))
    sigmas = np.array([second[name][3] for name in names])
    given = bool(np.isfinite(sigmas).all())
    weight = 1.0 / sigmas**2 if given else None
    found = absolute_orientation(points, control, weight, with_scale, 1.0 if given else sigma)
    if not np.isfinite(found.covariance[:6, :6]).all():
        raise InputError(f"{source}: {len(names)} points lie on a line or are too few to tell how well they fit")
    T = rigid_motion(found.scale * found.R, found.translation)
    residuals = np.linalg.norm(found.apply(points) - control, axis=1)
    rms, apart = np.sqrt(np.mean(residuals**2)), np.sqrt(control.var(axis=0).sum())
    content = {
        "T_target_source": T.tolist(),
        "scale": found.scale,
        "covariance": found.covariance.tolist(),
        "covariance_of": ["x", "y", "z", "turn_x", "turn_y", "turn_z", "log_scale"][: len(found.covariance)],
        "residuals": dict(zip(names, residuals.tolist(), strict=True)),
    }
    atomic_write_json(out, content)
    deviation = np.sqrt(np.diag(found.covariance))
    scale = f"; scale {found.scale:.6g} ± {found.scale * deviation[6]:.2g}" if with_scale else ""
    doubt = f"residuals of {rms / apart:.0%} of the spread: do ids, units (--scale) and handedness agree?\n"
    return (
        f"{doubt if rms > _MOST_OF_SPREAD * apart else ''}{len(names)} points, residuals rms {rms:.4g} m, largest "
        f"{residuals.max():.4g} m of {names[int(residuals.argmax())]}\nsigma     place of the centroid "
        f"{deviation[:3].max():.2g} m, turn {np.degrees(deviation[3:6].max()):.2g} deg{scale}\nWritten: {out}"
    )


def _read_pairs(path: Path, sigma: float) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Names (N,), pixels (N, 4) and covariances (N, 4, 4)."""
    if path.suffix.lower() == ".npz":
        shapes = {"keypoints0": ("M", 2), "keypoints1": ("M", 2), "covariance": ("M", 2, 2)}
        arrays = load_columns(path, "write it by `sigmaslam images match`", shapes, {})
        pixels = np.column_stack([arrays["keypoints0"], arrays["keypoints1"]]).astype(float)
        covariance = np.zeros((len(pixels), 4, 4))
        # What is known is the covariance of the difference; each image is given half of it.
        covariance[:, :2, :2] = covariance[:, 2:, 2:] = 0.5 * arrays["covariance"]
        return [str(k) for k in range(len(pixels))], pixels, covariance
    names, values = _read_table(path, _PIXELS)
    sigmas = np.where(np.isfinite(values[:, 4]), values[:, 4], sigma)
    return names, values[:, :4], sigmas[:, None, None] ** 2 * np.eye(4)


def _read_points(path: Path) -> dict[str, np.ndarray]:
    """By id x, y, z and sigma, which is NaN where the file has none."""
    names, values = _read_table(path, _PLACE)
    double = next((name for k, name in enumerate(names) if name in names[:k]), None)
    if double is not None:
        raise InputError(f"{path}: id {double} stands twice: remove the wrong line")
    return dict(zip(names, values, strict=True))


def _read_table(path: Path, columns: tuple[str, ...]) -> tuple[list[str], np.ndarray]:
    """Ids (N,), which are the numbers of the lines without any, and the columns and sigma (N, C + 1), NaN for none."""
    reader = csv.DictReader(io.StringIO(read_text(path, TABLE_BYTES, "the table"), newline=""), skipinitialspace=True)
    missing = [column for column in columns if column not in (reader.fieldnames or ())]
    if missing:
        raise InputError(
            f"{path}: no column {missing[0]} in '{shorten(','.join(reader.fieldnames or ()))}': give a header with "
            f"{','.join(columns)}, and if wanted id and sigma"
        )
    names, rows = [], []
    for number, row in enumerate(reader):
        try:
            values = [float(row[column]) for column in columns]
            sigma = float(row["sigma"]) if row.get("sigma") else np.nan
        except (TypeError, ValueError):
            values, sigma = [np.nan], np.nan
        # By None stands what is more than the header has columns, as of decimal commas.
        if not np.isfinite(values).all() or sigma <= 0.0 or sigma == np.inf or any(row.get(None, ())):
            cells = shorten(",".join(str(cell) for cell in row.values()))
            raise InputError(
                f"{path}, line {reader.line_num}: '{cells}' is not one finite number a column, or its sigma is not "
                "positive and finite: mend it"
            )
        names.append(row.get("id") or str(number))
        rows.append([*values, sigma])
    if not rows:
        raise InputError(f"{path}: has a header and no rows: give points")
    return names, np.array(rows)
