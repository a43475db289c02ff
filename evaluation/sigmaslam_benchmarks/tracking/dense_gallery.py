"""Dense clouds of docs/reconstruction.md: rendered sequences, tracked and reconstructed, from two viewpoints.

`python -m sigmaslam_benchmarks.tracking.dense_gallery --out docs/images --work build/gallery`
"""

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.files import atomic_path
from sigmaslam.geometry.se3 import rotation_exp, se3_inverse, transform_points
from sigmaslam.readers import open_sequence
from sigmaslam.readers.trajectory_files import read_tum
from sigmaslam.reconstruction.reconstruct import reconstruct_run
from sigmaslam.run_record.dense_points import DENSE_NAME, RECONSTRUCTION_NAME, read_dense_points
from sigmaslam.run_record.removal import remove_run
from sigmaslam_benchmarks.tracking.tracking_gallery import RECIPES, run_gallery
from sigmaslam_benchmarks.trial import render, track_ours
from sigmaslam_synthetic.simulation import Recipe

# Of a picture: width and height, pixels, and focal length in widths.
_WIDTH, _HEIGHT, _FOCAL = 640, 400, 0.9
# Sides of the squares that points are drawn as: of the space between points, and at most, pixels.
_FILL, _LARGEST = 1.5, 9
# Viewpoints: turns about the middle of what is near (pitch and yaw, radians) and how much farther from it.
_VIEWPOINTS = ((0.0, 0.0, 1.15), (-0.45, 0.6, 1.5))
_QUALITY = 80
_BACKGROUND = 40
MAX_BYTES = 300_000
"""Of a picture on a page."""


def draw_points(
    points: np.ndarray, colours: np.ndarray, T_camera_world: np.ndarray, focal: float, spacing: float
) -> np.ndarray:
    """Points as squares of their size, the nearer before the farther.

    Args:
        points: (N, 3) in the world, metres.
        colours: (N, 3) uint8.
        T_camera_world: (4, 4) of the viewpoint.
        focal: length, pixels.
        spacing: between points, metres.
    Returns:
        (H, W, 3) uint8.
    """
    picture = np.full((_HEIGHT, _WIDTH, 3), _BACKGROUND, np.uint8)
    seen = transform_points(T_camera_world, points)
    ahead = seen[:, 2] > 2.0 * spacing
    seen, colours = seen[ahead], colours[ahead]
    # A later write wins, so the farthest come first.
    order = np.argsort(-seen[:, 2])
    seen, colours = seen[order], colours[order]
    side = np.clip(np.ceil(_FILL * focal * spacing / seen[:, 2]), 1, _LARGEST).astype(np.int64)
    corner = np.rint(focal * seen[:, :2] / seen[:, 2:] + np.array([_WIDTH, _HEIGHT]) / 2.0 - side[:, None] / 2.0)
    steps = np.stack(np.meshgrid(np.arange(_LARGEST), np.arange(_LARGEST)), axis=-1).reshape(-1, 2)
    pixels = corner.astype(np.int64)[:, None] + steps
    drawn = (steps < side[:, None, None]).all(axis=-1)
    drawn &= ((pixels >= 0) & (pixels < np.array([_WIDTH, _HEIGHT]))).all(axis=-1)
    point, step = np.nonzero(drawn)
    u, v = pixels[point, step].T
    picture[v, u] = colours[point]
    return picture


def draw_run(run: Path) -> np.ndarray:
    """The cloud of a reconstructed run from two viewpoints: in its colours, and by the sigma of its points."""
    cloud = read_dense_points(run / DENSE_NAME)
    poses = read_tum(run / "trajectory.tum").poses
    halfway = poses[len(poses) // 2]
    x, _, z = transform_points(se3_inverse(halfway), cloud.points).T
    middle = np.array([0.0, 0.0, float(np.median(z[np.abs(x) < z]))])
    focal = _FOCAL * _WIDTH
    # The summary's voxel is the space between the points of the whole cloud, of which this is a selection.
    summary = json.loads((run / RECONSTRUCTION_NAME).read_text(encoding="utf-8"))
    spacing = summary["voxel"] * np.sqrt(summary["points"] / len(cloud.points))
    logarithm = np.log(cloud.sigma)
    low, high = np.percentile(logarithm, (2, 98))
    level = (255.0 * np.clip((logarithm - low) / max(high - low, 1e-9), 0.0, 1.0)).astype(np.uint8)
    by_sigma = cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS).reshape(-1, 3)
    rows = []
    for pitch, yaw, farther in _VIEWPOINTS:
        orbit = np.eye(4)
        orbit[:3, :3] = rotation_exp(np.array([0.0, yaw, 0.0])) @ rotation_exp(np.array([pitch, 0.0, 0.0]))
        orbit[:3, 3] = middle - farther * orbit[:3, :3] @ middle
        view = se3_inverse(halfway @ orbit)
        rows.append(
            np.hstack(
                [draw_points(cloud.points, each, view, focal, spacing) for each in (cloud.colours[:, ::-1], by_sigma)]
            )
        )
    return np.vstack(rows)


def write_dense_gallery(out: Path, work: Path, recipes: Sequence[Recipe] = RECIPES) -> list[Path]:
    """Renders, tracks and reconstructs sequences, and writes pictures of the clouds, `dense_<preset>.webp`.

    Args:
        out: folder of the pictures.
        work: folder for renders and runs; frames that are there are kept.
        recipes: of the sequences.
    """
    out.mkdir(parents=True, exist_ok=True)
    work.mkdir(parents=True, exist_ok=True)
    written = []
    for recipe in recipes:
        run = work / f"dense_{recipe.preset}{recipe.seed}"
        remove_run(run)
        track_ours(open_sequence(render(work, recipe, workers=1)), run)
        reconstruct_run(run, run / "cloud.ply")
        path = out / f"dense_{recipe.preset}.webp"
        with atomic_path(path) as temporary:
            cv2.imwrite(str(temporary), draw_run(run), [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
        written.append(path)
    return written


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    run_gallery("dense_gallery", __doc__, write_dense_gallery, arguments)


if __name__ == "__main__":
    main()
