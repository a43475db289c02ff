"""How hard a rendered sequence moves in the image: flow, its reversals and the blur, from the exact landmarks."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sigmaslam_benchmarks.rendered_camera import read_simulation
from sigmaslam_synthetic.render_sequence import LANDMARKS_NAME

_FEWEST = 8  # landmarks whose median is a flow


@dataclass(frozen=True, slots=True)
class ImageMotion:
    """Of what rests, in the left image, the median over it.

    Attributes:
        flow: largest length from a frame to the next one, pixels.
        reversal: largest difference between two flows within half a second, pixels.
        blur_left: largest length of the motion blur, pixels.
    """

    flow: float
    reversal: float
    blur_left: float


def read_image_motion(source: Path) -> ImageMotion:
    """The motion in a rendered folder."""
    simulation = read_simulation(source)
    with np.load(source / LANDMARKS_NAME) as content:
        landmarks = dict(content)
    still = ~simulation.scene.moving[landmarks["body"]]
    flows = _flows(
        simulation.frames,
        landmarks["track_frame"],
        landmarks["track_landmark"],
        landmarks["track_left"],
        landmarks["track_left_visible"] & still[landmarks["track_landmark"]],
    )
    largest = _largest(flows)
    return ImageMotion(largest, largest_reversal(flows, int(0.5 * simulation.fps)), simulation.sensor.shutter * largest)


def largest_reversal(flows: np.ndarray, reach: int) -> float:
    """Largest difference between two of the flows (N, 2), `reach` frames apart at most; NaN without any."""
    differences = [flows[k:] - flows[:-k] for k in range(1, min(reach, len(flows) - 1) + 1)]
    return _largest(np.concatenate(differences)) if differences else float("nan")


def _flows(frames: int, frame: np.ndarray, landmark: np.ndarray, pixels: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Median flow (frames - 1, 2) from each frame to the next, of observations (M,); NaN where few are seen twice."""
    result = np.full((max(frames - 1, 0), 2), np.nan)
    rows = [np.flatnonzero(used & (frame == k)) for k in range(frames)]
    for k in range(frames - 1):
        _, now, later = np.intersect1d(landmark[rows[k]], landmark[rows[k + 1]], return_indices=True)
        if len(now) >= _FEWEST:
            result[k] = np.median(pixels[rows[k + 1][later]] - pixels[rows[k][now]], axis=0)
    return result


def _largest(vectors: np.ndarray) -> float:
    lengths = np.linalg.norm(vectors, axis=-1)
    lengths = lengths[np.isfinite(lengths)]
    return float(lengths.max()) if len(lengths) else float("nan")
