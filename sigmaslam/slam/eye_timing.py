"""Whether the eyes show one moment: landmarks have rows in a late eye that they had in the other one a frame before."""

from collections import deque

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.frontend.lucas_kanade import in_light_of, lucas_kanade
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_inverse
from sigmaslam.slam.frame import Frame

SPOILT = 20
"""Frames without a fault after those with one, which have spoilt the map."""
# Frames whose rows are compared together, as in a single one most may move alike, and the fewest landmarks in them:
# in frames of 13 good recordings 15,080 draws of 30 had a ratio of 1 / 1.6 at worst, of 15 two were beyond 1 / 2.
_FRAMES, _FEWEST = 4, 30
# Landmarks that are followed to the right eye, or twice as many.
_FOLLOWED = 32
# Side of their patches, pixels, which reach half as many rows, and how well rows of equal patches are found, pixels.
_WINDOW, _PRECISE = 21, 0.03


class EyeTiming:
    """Compares rows of the eyes, `baseline` metres apart, in a frame with those in successive ones.

    Attributes:
        drift: metres by which poses may be off as eyes were apart, one standard deviation.
    """

    def __init__(self, baseline: float) -> None:
        self._baseline = baseline
        self.drift = self._next_drift = 0.0
        self._last = np.zeros(0, np.int64), np.zeros((0, 2)), np.eye(4)
        self._rows: deque[np.ndarray] = deque(maxlen=_FRAMES)
        self._apart_for = 0

    def are_apart(self, frame: Frame, pose: np.ndarray, ids: np.ndarray, seen: np.ndarray, follows: bool) -> bool:
        """Whether one eye is a frame behind, or was so shortly before.

        Args:
            frame: the current one.
            pose: (4, 4) of it, T_world_camera.
            ids, seen: (M,) and (M, 3) (u, v, disparity) of the landmarks that agree with its pose.
            follows: the frame before had a pose, too.
        """
        stereo = np.isfinite(seen[:, 2])
        # A power of two, so that most of them are those of the frame before.
        share = 1 << (max(int(stereo.sum()) // _FOLLOWED, 1).bit_length() - 1)
        chosen = np.flatnonzero(stereo & (ids % share == 0))
        expected, lit = RectifiedStereo.right_pixels(seen[chosen]), in_light_of(frame.left, frame.right)
        found, ended = lucas_kanade(frame.left, lit, seen[chosen, :2], expected, _WINDOW, 0)
        rows = np.column_stack([seen[:, 1], np.full(len(seen), np.nan)])
        rows[chosen[ended], 1] = found[ended, 1]
        both, now, then = np.intersect1d(ids, self._last[0], assume_unique=True, return_indices=True)
        (left, right), (old_left, old_right) = rows[now].T, self._last[1][then].T
        self._rows.append(np.stack([right - left, right - old_left, old_right - left])[:, : follows * len(both)])
        step, self._last = (se3_inverse(self._last[2]) @ pose)[:3, 3], (ids, rows, pose)
        differences = np.concatenate(self._rows, axis=1)
        enough, scatter = np.isfinite(differences).sum(axis=1) >= _FEWEST, np.full(3, np.inf)
        if enough[0]:
            middle = _medians(differences[enough])
            scatter[enough] = _medians(np.abs(differences[enough] - middle[:, None]))
            same, late, early = scatter
            if ACCEPTANCE.other_moment * max(min(late, early), _PRECISE) < same:
                self._apart_for = SPOILT
            elif ACCEPTANCE.other_moment * same < min(late, early):
                self._apart_for = max(self._apart_for - 1, 0)
                if not self._apart_for:
                    self._next_drift = self.drift
        # Disparities are off by as much as rows, and the baseline by what the camera moves along it.
        off = scatter[0] / np.median(seen[stereo, 2]) if enough[0] and stereo.any() else 0.0
        self._next_drift += follows * float(np.hypot(off, step[0] / self._baseline) * np.linalg.norm(step))
        if self._apart_for:
            self.drift = self._next_drift
        return self._apart_for > 0


def _medians(values: np.ndarray) -> np.ndarray:
    """`np.nanmedian` to the bit of rows (K, N), none of them NaN alone; that takes ten times longer for a few rows."""
    ranked, count, rows = np.sort(values, axis=1), np.isfinite(values).sum(axis=1), np.arange(len(values))
    return np.asarray((ranked[rows, (count - 1) // 2] + ranked[rows, count // 2]) / 2.0)
