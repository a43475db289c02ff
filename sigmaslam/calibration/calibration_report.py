"""A calibration from a board as a file, in words, and as a picture."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from sigmaslam.calibration.board_bundle import INTRINSICS
from sigmaslam.calibration.calibrate import BoardCalibration
from sigmaslam.calibration.lens_choice import folds
from sigmaslam.calibration.tracker_covariance import tracker_covariance
from sigmaslam.calibration_files.calibration_writer import camera_entries, write_calibration
from sigmaslam.files import atomic_path, atomic_write_text
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.plot_style import BLUE, GREY, VERMILLION, style_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Cells in which corners are looked for, columns and rows.
_CELLS = (8, 6)
# A share of the cells, below which the lens is extrapolated rather than measured.
_COVERED = 0.6
# Residuals are drawn so much longer.
_ENLARGED = 40.0


def write_board_calibration(path: Path, result: BoardCalibration) -> None:
    """Write a calibration: of a pair in the form that `track` reads, of one camera under `camera`.

    `covariance` is that of the errors that the tracker considers; `parameters` holds all parameters with theirs.

    Raises:
        CalibrationError: the right camera does not stand beside the left one.
        InputError: the folder cannot be written.
    """
    eyes = result.rig.eyes
    more: dict[str, Any] = {
        "residuals": {
            "rms": round(result.rms, 4),
            "sigma": round(result.sigma, 4),
            "images": len(result.names),
            "corners": len(result.corners),
            "outlier_corners": len(result.outlier_corners),
            "outlier_images": {each.name: each.reason for each in result.outlier_images},
        },
        "parameters": {
            "names": list(result.rig.names),
            "sigmas": _rounded(result.sigmas),
            "covariance": _rounded(result.covariance),
        },
    }
    if len(eyes) > 1:
        covariance, _ = tracker_covariance(result.rig, result.covariance)
        camera = StereoCamera(eyes[0], eyes[1], result.rig.T_left_right, covariance=covariance)
        write_calibration(path, camera, more)
        return
    text = yaml.safe_dump({"camera": camera_entries(eyes[0]), **more}, sort_keys=False, default_flow_style=None)
    atomic_write_text(path, f"# Pixels.\n{text}")


def describe_board_calibration(result: BoardCalibration) -> str:
    """Residuals, parameters with sigmas, coverage and what is doubtful, a line each."""
    eyes, sigmas = result.rig.eyes, dict(zip(result.rig.names, result.sigmas, strict=True))
    by_eye = ", ".join(f"{name} {result.eye_rms(k):.3f}" for k, name in enumerate(_names(result)))
    lines = [
        f"images    {len(result.names)} used, {len(result.outlier_images)} left out; "
        f"{len(result.corners)} corners, {len(result.outlier_corners)} left out",
        f"residuals rms {result.rms:.3f} px ({by_eye}); with the corners left out {result.rms_of_all:.3f} px; "
        f"images differ {np.sqrt(result.design_effect):.1f} times as much as independent corners would make them",
    ]
    for name, eye in zip(_names(result), eyes, strict=True):
        values = [getattr(eye, each) for each in INTRINSICS]
        words = [
            f"{each} {value:.2f} ± {sigmas[f'{name}.{each}']:.2f}"
            for each, value in zip(INTRINSICS, values, strict=True)
        ]
        lens = [f"{value:.5f} ± {sigmas[f'{name}.d{k}']:.5f}" for k, value in enumerate(eye.distortion)]
        lines.append(f"{name:9s} {', '.join(words)}; {eye.distortion_model} {', '.join(lens)}")
    if len(eyes) > 1:
        position = result.rig.T_left_right[:3, 3]
        along = position / np.linalg.norm(position)
        place = [result.rig.names.index(f"T_left_right.{axis}") for axis in "xyz"]
        # A turn of the perturbation about the left camera moves the right one at right angles to the baseline.
        sigma = float(np.sqrt(along @ result.covariance[np.ix_(place, place)] @ along))
        lines.append(f"baseline  {1e3 * np.linalg.norm(position):.3f} ± {1e3 * sigma:.3f} mm")
        covariance, share = tracker_covariance(result.rig, result.covariance)
        words = [
            f"{name} {sigma:.1e}"
            for name, sigma in zip(covariance.names, np.sqrt(np.diag(covariance.matrix)), strict=True)
        ]
        lines.append(f"tracker   sigmas: {', '.join(words)}; they describe {100 * share:.0f} % of the variance")
    covered = [f"{name} {100 * coverage(result, k):.0f} %" for k, name in enumerate(_names(result))]
    lines.append(f"coverage  {', '.join(covered)} of {_CELLS[0]}x{_CELLS[1]} cells")
    lines += [f"left out  {each.name}: {each.reason}" for each in result.outlier_images]
    return "\n".join([*lines, *(f"warning   {each}" for each in _doubts(result))])


def coverage(result: BoardCalibration, eye: int) -> float:
    """Share of the cells of an eye's image with a corner."""
    model = result.rig.eyes[eye]
    pixels = result.corners.pixels[result.corners.eye == eye]
    cells = (pixels / (model.width, model.height) * _CELLS).astype(int)
    return len(np.unique(cells, axis=0)) / (_CELLS[0] * _CELLS[1])


def draw_board_calibration(path: Path, result: BoardCalibration) -> None:
    """Draw where corners are in each eye with their residuals, and the rms of each image."""
    eyes = result.rig.eyes
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0 * len(eyes), 7.0), layout="constrained")
    grid = figure.subplots(2, len(eyes), squeeze=False, height_ratios=(2, 1))
    for k, (name, eye) in enumerate(zip(_names(result), eyes, strict=True)):
        _draw_corners(grid[0, k], result, k, eye)
        grid[0, k].set_title(
            f"{name}: rms {result.eye_rms(k):.3f} px, corners in {100 * coverage(result, k):.0f} % of the cells"
        )
        mine = result.corners.eye == k
        images = result.corners.image[mine]
        squared = np.bincount(images, np.sum(result.residuals[mine] ** 2, axis=1), len(result.names))
        counts = np.maximum(np.bincount(images, minlength=len(result.names)), 1)
        grid[1, k].bar(range(len(result.names)), np.sqrt(squared / counts), color=BLUE)
        style_axes(grid[1, k])
        grid[1, k].set(ylabel="rms, px", xticks=range(len(result.names)))
        grid[1, k].set_xticklabels([each.split(" + ")[0] for each in result.names], rotation=90, fontsize=7)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=100)


def _draw_corners(axes: "Axes", result: BoardCalibration, k: int, eye: CameraModel) -> None:
    mine = result.corners.eye == k
    (u, v), (du, dv) = result.corners.pixels[mine].T, result.residuals[mine].T
    axes.set(xlim=(-0.5, eye.width - 0.5), ylim=(eye.height - 0.5, -0.5), aspect="equal")
    axes.quiver(u, v, _ENLARGED * du, _ENLARGED * dv, color=BLUE, angles="xy", scale_units="xy", scale=1, width=0.0015)
    out = result.outlier_corners.pixels[result.outlier_corners.eye == k]
    axes.plot(*out.T, "x", color=VERMILLION, ms=4, label=f"{len(out)} corners left out")
    for x in np.linspace(0, eye.width, _CELLS[0] + 1)[1:-1]:
        axes.axvline(x, color=GREY, lw=0.3)
    for y in np.linspace(0, eye.height, _CELLS[1] + 1)[1:-1]:
        axes.axhline(y, color=GREY, lw=0.3)
    axes.set_xlabel(f"u, px (residuals x {_ENLARGED:.0f})")
    axes.set_ylabel("v, px")
    axes.legend(loc="lower right", fontsize=7)


def _doubts(result: BoardCalibration) -> list[str]:
    doubts = []
    if result.rms > 1.0:
        doubts.append(f"residuals of {result.rms:.2f} px (0.1 to 0.3 are usual): another --board, a bent one, or blur?")
    for k, (name, eye) in enumerate(zip(_names(result), result.rig.eyes, strict=True)):
        if coverage(result, k) < _COVERED:
            doubts.append(f"{name}: large parts of the image show no board, the lens is extrapolated: move it there")
        if folds(eye):
            doubts.append(f"{name}: the lens folds before the image's corners: show the board there, or try another")
        if eye.distortion_model == "radtan" and len(eye.distortion) > 4:
            last = len(eye.distortion) - 1
            sigma = float(result.sigmas[result.rig.names.index(f"{name}.d{last}")])
            if abs(eye.distortion[last]) < sigma:
                found = f"{eye.distortion[last]:.3f} ± {sigma:.3f}"
                doubts.append(f"{name}: the last coefficient of the lens is {found}, nothing: try --lens radtan4")
        focal = float(result.sigmas[result.rig.names.index(f"{name}.fx")]) / eye.fx
        if focal > 0.01:
            doubts.append(f"{name}: the focal length is known to {100 * focal:.0f} %: tilt the board by 30 degrees")
    return doubts


def _names(result: BoardCalibration) -> tuple[str, ...]:
    return ("left", "right")[: len(result.rig.eyes)]


def _rounded(values: np.ndarray) -> Any:
    """Lists of numbers with nine digits."""
    return np.array([float(f"{value:.9g}") for value in values.ravel().tolist()]).reshape(values.shape).tolist()
