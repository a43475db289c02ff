"""Rectified pairs with true disparities: LiDAR, Middlebury, renders, and renders as a worse camera sees them."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.reconstruction.disparity import pixel_grid
from sigmaslam_benchmarks.matching.photographs import middlebury_scenes
from sigmaslam_synthetic.simulation import Recipe, Studio, simulate

DRIVE, MIDDLEBURY = "kitti_raw_0926_0039_a", "disparity_middlebury"
"""Folders of the real data."""
WORLDS = ("street", "room", "organ")
DETAILED = {"street, detailed": Path(__file__).resolve().parents[3] / "examples" / "detailed_street.py"}
"""Worlds of the checkout's examples, filmed as streets are."""
RENDERED_FRAMES = (0, 3)
"""Of each render."""
# Focal length times baseline of the drive, pixels times metres; its truth's own errors, pixels and share.
_DRIVE_FOCAL_BASELINE, _LIDAR_SIGMA, _LIDAR_SHARE = 387.5744, 0.2, 0.01
# Of Middlebury 2014, and of the rounding of the 2006 disparities to whole pixels.
_STRUCTURED_LIGHT, _WHOLE_PIXELS = 0.05, 1.0 / np.sqrt(12.0)


@dataclass(frozen=True, slots=True)
class DisparityPair:
    """A rectified pair with true disparities.

    Attributes:
        left, right: (H, W) uint8 images.
        truth: (H, W) float32 disparities, NaN where they are not known or the right eye does not see the point.
        sigma: (H, W) of the truth, pixels.
        focal_baseline: pixels times metres, of a pair whose truth comes from scans with a time error; None: of others.
    """

    left: np.ndarray
    right: np.ndarray
    truth: np.ndarray
    sigma: np.ndarray
    focal_baseline: float | None = None


def real_pairs(data: Path) -> dict[str, list[DisparityPair]]:
    """Pairs of each real set.

    Raises:
        InputError: a file is missing.
    """
    return {"drive": _lidar_pairs(data / DRIVE), **_middlebury_pairs(data / MIDDLEBURY)}


def rendered_pairs(seeds: tuple[int, ...], worlds: tuple[str, ...] = WORLDS) -> dict[str, list[DisparityPair]]:
    """Two frames of a render of each world and seed, at the presets' sizes."""
    pairs: dict[str, list[DisparityPair]] = {world: [] for world in worlds}
    for world, of_world in pairs.items():
        preset, file = ("street", str(DETAILED[world])) if world in DETAILED else (world, None)
        for seed in seeds:
            studio = Studio(simulate(Recipe(preset, max(RENDERED_FRAMES) + 1, seed, world=file)), device="cpu")
            for frame in studio.frames(np.array(RENDERED_FRAMES)):
                truth = np.where(frame.stereo_visible & np.isfinite(frame.depth), -frame.stereo[..., 0], np.nan)
                truth = truth.astype(np.float32)
                of_world.append(DisparityPair(frame.left, frame.right, truth, np.zeros_like(truth)))
    return pairs


def worse_camera(pair: DisparityPair, rng: np.random.Generator) -> DisparityPair:
    """The pair as unlike eyes see it: rows are off, gain, gamma and blur differ, and parts may be saturated.

    The noise is that of a machine-vision sensor with 8 bits: 1 grey value of reading, and shot noise of 0.02 grey
    values squared a grey value. The ranges are those of the real sets, and of rectification to 0.15 pixels.
    """
    height, width = pair.left.shape
    u, v = pixel_grid(height, width)
    exposure, plane = np.exp(rng.uniform(-0.3, 0.7)), rng.normal(0.0, 0.15, 3)
    rows = v - plane[0] - plane[1] * (u / width - 0.5) - plane[2] * (v / height - 0.5)
    radius = np.minimum(((u - width / 2) ** 2 + (v - height / 2) ** 2) / (width / 2) ** 2, 1.0)
    seen = []
    for image, lines in ((pair.left, v), (pair.right, rows)):
        moved = cv2.remap(
            image.astype(np.float32), u, lines.astype(np.float32), cv2.INTER_CUBIC, None, cv2.BORDER_REPLICATE
        )
        blur = rng.uniform(0.2, 0.7)
        sharp, soft = (cv2.GaussianBlur(moved, (0, 0), each) for each in (blur, blur + 0.4))
        light = np.maximum(sharp + (soft - sharp) * radius, 0.0) / 255.0
        value = 255.0 * light ** rng.uniform(0.93, 1.07) * exposure * rng.uniform(0.9, 1.1) * (1.0 - 0.15 * radius)
        value += rng.normal(size=value.shape) * np.sqrt(1.0 + 0.02 * value)
        seen.append(np.clip(np.rint(value), 0, 255).astype(np.uint8))
    return DisparityPair(seen[0], seen[1], pair.truth, pair.sigma)


def _lidar_pairs(folder: Path) -> list[DisparityPair]:
    pairs = []
    for path in sorted((folder / "lidar").glob("depth_*.npz")):
        name = f"{path.stem.removeprefix('depth_')}.png"
        left, right = (_grey(folder / f"image_{eye}" / name) for eye in range(2))
        truth = np.full(left.shape, np.nan, np.float32)
        with np.load(path) as scan:
            truth[scan["v"], scan["u"]] = _DRIVE_FOCAL_BASELINE / scan["z"]
        pairs.append(
            DisparityPair(left, right, truth, np.hypot(_LIDAR_SIGMA, _LIDAR_SHARE * truth), _DRIVE_FOCAL_BASELINE)
        )
    if not pairs:
        raise InputError(f"{folder / 'lidar'}: has no depth_*.npz: give --data the folder with the LiDAR of the drive")
    return pairs


def _middlebury_pairs(folder: Path) -> dict[str, list[DisparityPair]]:
    sigmas, pairs = {"Motorcycle": _STRUCTURED_LIGHT, "aloe": _WHOLE_PIXELS}, {}
    for name, (left, right, truth) in middlebury_scenes(folder).items():
        sigma = np.full(truth.shape, sigmas[name], np.float32)
        pairs[name] = [DisparityPair(_grey(left), _grey(right), truth.astype(np.float32), sigma)]
    return pairs


def _grey(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise InputError(f"{path}: is missing, or no image: give --data the folder of the real data sets")
    return np.asarray(image)
