"""Observations of a run: the file tracks.npz."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sigmaslam.bounded_files import load_columns
from sigmaslam.errors import InputError

TRACKS_NAME = "tracks.npz"


@dataclass(frozen=True, slots=True)
class Tracks:
    """Observations of landmarks by keyframes, and the rectified pair that made them.

    Attributes:
        frame: (O,) int64, row of the observing keyframe in the trajectory.
        landmark: (O,) int64, any numbers; the first observation of a landmark in this order is its host.
        measurement: (O, 3) (u, v, disparity) in the rectified left image, pixels; disparity may be NaN.
        covariance: (O, 3, 3) pixels squared; row and column of a disparity of NaN have no meaning.
        intrinsics: (5,) fx, fy, cx, cy in pixels and the baseline in metres.
        R_rectified_left: (3, 3) takes left-camera to rectified coordinates; both have the same centre.
        disparity_offset: (2,) the tracker's last estimate of measured minus true disparity, and its sigma, pixels.
    """

    frame: np.ndarray
    landmark: np.ndarray
    measurement: np.ndarray
    covariance: np.ndarray
    intrinsics: np.ndarray
    R_rectified_left: np.ndarray
    disparity_offset: np.ndarray

    def __len__(self) -> int:
        return len(self.frame)


_SHAPES: dict[str, tuple[str | int, ...]] = {
    **{"frame": ("O",), "landmark": ("O",), "measurement": ("O", 3), "covariance": ("O", 3, 3)},
    **{"intrinsics": (5,), "R_rectified_left": (3, 3), "disparity_offset": (2,)},
}
_KINDS = {name: "iu" if name in ("frame", "landmark") else "iuf" for name in _SHAPES}
_MEND = "run `sigmaslam track --tracks` again"


def read_tracks(path: Path, frames: int) -> Tracks:
    """Reads and checks tracks.npz.

    Args:
        frames: poses in the trajectory of the same run.
    Raises:
        InputError: there is no such file, it is truncated, or its content is wrong (the message says where).
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; {_MEND.replace(' again', '')} to make a run with the observations")
    arrays = load_columns(path, _MEND, _SHAPES, _KINDS)
    arrays = {name: each.astype(np.int64 if _KINDS[name] == "iu" else np.float64) for name, each in arrays.items()}
    tracks = Tracks(**arrays)
    _check(path, tracks, frames)
    return tracks


def _check(path: Path, tracks: Tracks, frames: int) -> None:
    def refuse(wrong: np.ndarray, what: str) -> None:
        rows = np.flatnonzero(wrong)
        if len(rows):
            raise InputError(f"{path}: observation {rows[0]} and {len(rows) - 1} more: {what}; {_MEND}")

    if len(tracks) == 0:
        raise InputError(f"{path}: holds no observations; was anything tracked? Look into frames.csv of the run")
    refuse(
        (tracks.frame < 0) | (tracks.frame >= frames),
        f"frame is not in the trajectory beside it, which has {frames} poses; both must come from the same run",
    )
    refuse(~np.isfinite(tracks.measurement[:, :2]).all(axis=1), "u or v is not finite")
    refuse(np.isinf(tracks.measurement[:, 2]), "disparity is infinite")
    covariance = without_disparity(tracks.measurement, tracks.covariance)
    refuse(~np.isfinite(covariance).all(axis=(1, 2)), "covariance is not finite")
    refuse(np.linalg.eigvalsh(covariance)[:, 0] <= 0, "covariance is not positive definite")
    if not np.isfinite(tracks.intrinsics).all() or (tracks.intrinsics[[0, 1, 4]] <= 0).any():
        raise InputError(f"{path}: intrinsics {tracks.intrinsics} need positive fx, fy and baseline; {_MEND}")
    R = tracks.R_rectified_left
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
        raise InputError(f"{path}: R_rectified_left is no rotation:\n{R}\n{_MEND}")
    if not np.isfinite(tracks.disparity_offset).all():
        raise InputError(f"{path}: disparity_offset {tracks.disparity_offset} is not finite; {_MEND}")


def without_disparity(measurement: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Covariances (O, 3, 3) in which a disparity of NaN has unit variance and no correlation."""
    missing = np.isnan(measurement[:, 2])
    result = covariance.copy()
    result[missing, 2, :] = result[missing, :, 2] = 0.0
    result[missing, 2, 2] = 1.0
    return result
