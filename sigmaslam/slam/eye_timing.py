"""Whether both eyes show one moment, by the rows of landmarks: those of a late eye are the other's a frame before."""

from collections import deque

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.slam.frame import Frame
from sigmaslam.slam.rig_change import follow_to_right

# Frames whose rows are compared together, as in a single one most may move alike, and the fewest landmarks in them:
# of 30 in any frame of 13 good recordings no draw of 15,080 came near the ratio, of 15 two fell below it.
_FRAMES, _FEWEST = 4, 30
# So many landmarks are followed, or up to twice as many: that takes time in each frame.
_FOLLOWED = 32
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
        stereo = np.isfinite(seen[:, 2])
        # Powers of two, so that most of them are those of the frame before.
        share = 1 << (max(int(stereo.sum()) // _FOLLOWED, 1).bit_length() - 1)
        chosen = np.flatnonzero(stereo & (landmark_id % share == 0))
        moved, places, good = follow_to_right(frame.left, frame.right, seen[chosen])
        rows = np.column_stack([seen[:, 1], np.full(len(seen), np.nan)])
        rows[chosen[good], 1] = (places + moved)[:, 1]
        if self._last is not None and follows:
            _, now, then = np.intersect1d(landmark_id, self._last[0], assume_unique=True, return_indices=True)
            (left, right), (old_left, old_right) = rows[now].T, self._last[1][then].T
            self._rows.append(np.stack([right - left, right - old_left, old_right - left]))
        self._last = landmark_id, rows
        differences = np.concatenate([np.zeros((3, 0)), *self._rows], axis=1)
        enough = np.isfinite(differences).sum(axis=1) >= _FEWEST
        if enough[0]:
            middle = np.nanmedian(differences, axis=1, keepdims=True)
            scatter = np.nanmedian(np.abs(differences - middle), axis=1)
            same, late, early = np.where(enough, scatter, np.inf)
            if ACCEPTANCE.other_moment * min(late, early) < same:
                self._apart_for = _SPOILT + 1
            elif self._apart_for > 1 and ACCEPTANCE.other_moment * same < min(late, early):
                self._apart_for -= 1
        return self._apart_for > 0
