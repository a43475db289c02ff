"""dense.npz and reconstruction.json of a run: points of `sigmaslam map reconstruct` that its report shows."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sigmaslam.bounded_files import load_columns
from sigmaslam.files import save_arrays
from sigmaslam.table import even_rows

DENSE_NAME, RECONSTRUCTION_NAME, CLOUD_NAME = "dense.npz", "reconstruction.json", "cloud.ply"
MAX_POINTS = 150_000
"""Of a denser cloud an even selection is kept, so that the report has 3.0 MB of it."""
_MEND = "run `sigmaslam map reconstruct` again"


@dataclass(frozen=True, slots=True)
class RecordedPoints:
    """Points of a map, or of surfaces.

    Attributes:
        points: (N, 3) in the world, metres.
        sigma: (N,) root of the largest eigenvalue of the covariance, metres; NaN where it is not known.
        colours: (N, 3) red, green and blue in the images, 0 to 255, all three the grey value of a map; NaN where they
            are not known.
    """

    points: np.ndarray
    sigma: np.ndarray
    colours: np.ndarray


def write_dense_points(path: Path, points: np.ndarray, sigma: np.ndarray, colours: np.ndarray) -> None:
    """Writes an even selection of points with sigma and colours, as of `RecordedPoints`; float32 and uint8 are kept."""
    rows = even_rows(len(points), MAX_POINTS)
    shades = np.clip(np.rint(colours[rows]), 0, 255).astype(np.uint8)
    metres, sigmas = points[rows].astype(np.float32), sigma[rows].astype(np.float32)
    save_arrays(path, points=metres, sigma=sigmas, colours=shades)


def read_dense_points(path: Path) -> RecordedPoints:
    """The content of a dense.npz.

    Raises:
        InputError: it is no such file.
    """
    shapes: dict[str, tuple[str | int, ...]] = {"points": ("N", 3), "sigma": ("N",), "colours": ("N", 3)}
    return RecordedPoints(**load_columns(path, _MEND, shapes, {"colours": "u"}))
