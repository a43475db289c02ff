"""Which of thousands of keyframes look most like a view, by one vector each."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from sigmaslam.frontend import StereoView

# The best features of a view that its vector is made of, and the number of their dimensions: of longer descriptors a
# random projection, which keeps their angles.
_FEATURES, _DIMENSIONS = 300, 64
# Rows that are made room for at once.
_ROOM = 256


class AppearanceIndex:
    """Keyframes by what they look like.

    The vector is the second moment of a view's descriptors, its entries replaced by their signed square roots so that
    what repeats does not drown the rest (second-order pooling, Carreira et al. 2012). It needs no codebook, so that it
    serves descriptors of all front-ends. Thousands are compared in some milliseconds.
    """

    def __init__(self) -> None:
        self._ids = np.zeros(0, np.int64)
        self._vectors = np.zeros((0, 0), np.float32)

    def __len__(self) -> int:
        return len(self._ids)

    def add(self, id: int, view: StereoView) -> None:
        """Takes a keyframe by a number that no other one has."""
        vector, count = describe(view), len(self)
        if count == len(self._vectors):
            grown = np.zeros((count + _ROOM, len(vector)), np.float32)
            grown[:count] = self._vectors[:, : len(vector)] if count else 0.0
            self._vectors = grown
        self._vectors[count] = vector
        self._ids = np.append(self._ids, id)

    def remove(self, id: int) -> None:
        """Forgets a keyframe; the last row takes its place."""
        row = int(np.flatnonzero(self._ids == id)[0])
        last = len(self) - 1
        self._vectors[row], self._ids[row] = self._vectors[last], self._ids[last]
        self._ids = self._ids[:-1]

    def rank(self, view: StereoView, count: int, among: Collection[int] | None = None) -> list[int]:
        """Numbers of up to `count` keyframes that look most like the view, best first; of equals the newest first.

        Args:
            view: the current one.
            count: at most so many.
            among: numbers of those that are asked for; None: all.
        """
        if not len(self):
            return []
        similarity = self._vectors[: len(self)] @ describe(view)
        order = np.lexsort((-self._ids, -similarity))
        if among is not None:
            order = order[np.isin(self._ids[order], list(among))]
        return [int(id) for id in self._ids[order[:count]]]


def describe(view: StereoView) -> np.ndarray:
    """(C,) float32 of unit length, alike for views of one place; C = 0 where descriptors are empty."""
    descriptors = view.features.descriptors[:_FEATURES]
    if descriptors.shape[1] > _DIMENSIONS:
        projection = np.random.default_rng(0).normal(size=(descriptors.shape[1], _DIMENSIONS))
        descriptors = descriptors @ projection.astype(np.float32)
    row, column = np.triu_indices(descriptors.shape[1])
    # Entries beside the diagonal stand for two.
    moment = (descriptors.T @ descriptors)[row, column] * np.where(row == column, 1.0, 2.0)
    vector = np.sign(moment) * np.sqrt(np.abs(moment))
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12), np.float32)
