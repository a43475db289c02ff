"""Whether both eyes show one moment, by the rows of landmarks: those of a late eye are the other's a frame before."""

from collections import deque

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.slam.frame import Frame
from sigmaslam.slam.rig_change import follow_to_right

# Frames whose rows are compared together, and the fewest landmarks in them: in a single frame most move alike.
_FRAMES, _FEWEST = 4, 45
# Of the landmarks one in so many is followed, as that takes time in each frame.
_SHARE = 2
# Frames after the eyes agree again: they have spoilt the map.
_SPOILT = 20


class EyeTiming:
    """Compares the rows of both eyes in the same frame with those in successive ones."""

    def __init__(self) -> None:
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        self._rows: deque[np.ndarray] = deque(maxlen=_FRAMES)
        self._apart_for = 0

    def are_apart(self, frame: Frame, landmark_id: np.ndarray, seen: np.ndarray, follows: bool) -> bool:
        """Whether one eye was a frame behind in the last frames, or so shortly before that the map is spoilt.

        Args:
            frame: the current one.
            landmark_id, seen: (M,) and (M, 3) (u, v, disparity) of the landmarks that agree with its pose.
            follows: the frame before had a pose, too.
        """
        chosen = (landmark_id % _SHARE == 0) & np.isfinite(seen[:, 2])
        ids, uvd = landmark_id[chosen], seen[chosen]
        moved, places, good = follow_to_right(frame.left, frame.right, uvd)
        ids, rows = ids[good], np.column_stack([uvd[good, 1], (places + moved)[:, 1]])
        if self._last is not None and follows:
            _, now, then = np.intersect1d(ids, self._last[0], assume_unique=True, return_indices=True)
            (left, right), (old_left, old_right) = rows[now].T, self._last[1][then].T
            self._rows.append(np.stack([right - left, right - old_left, old_right - left]))
        self._last = ids, rows
        differences = np.concatenate([np.zeros((3, 0)), *self._rows], axis=1)
        if differences.shape[1] >= _FEWEST:
            middle = np.median(differences, axis=1, keepdims=True)
            same, late, early = np.median(np.abs(differences - middle), axis=1)
            if ACCEPTANCE.other_moment * min(late, early) < same:
                self._apart_for = _SPOILT + 1
            elif self._apart_for > 1 and ACCEPTANCE.other_moment * same < min(late, early):
                self._apart_for -= 1
        return self._apart_for > 0
