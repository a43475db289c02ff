"""Which of thousands of keyframes look most like a view, by one vector each."""

from collections.abc import Collection

import numpy as np

from sigmaslam.frontend import StereoView

# The best features of a view that its vector is made of, and the number of their dimensions: of longer descriptors a
# random projection, which keeps their angles.
_FEATURES, _DIMENSIONS = 300, 64


class AppearanceIndex:
    """Keyframes by what they look like.

    The vector is the second moment of a view's descriptors, its entries replaced by their signed square roots so that
    what repeats does not drown the rest (second-order pooling, Carreira et al. 2012). It needs no codebook, so that it
    serves descriptors of all front-ends. Thousands are compared in some milliseconds.
    """

    def __init__(self) -> None:
        self._vectors: dict[int, np.ndarray] = {}

    def __len__(self) -> int:
        return len(self._vectors)

    def add(self, id: int, descriptors: np.ndarray) -> None:
        """Takes a keyframe by a number that no other one has, with descriptors (N, D) of its features, best first."""
        self._vectors[id] = describe(descriptors)

    def remove(self, id: int) -> None:
        """Forgets a keyframe."""
        del self._vectors[id]

    def rank(self, view: StereoView, count: int, among: Collection[int] | None = None) -> list[int]:
        """Numbers of up to `count` keyframes that look most like the view, best first; of equals the newest first.

        Args:
            count: at most so many.
            among: numbers of those that are asked for; None: all.
        """
        ids = np.array([id for id in self._vectors if among is None or id in among], np.int64)
        if not len(ids):
            return []
        similarity = np.stack([self._vectors[id] for id in ids.tolist()]) @ describe(view.features.descriptors)
        return [int(id) for id in ids[np.lexsort((-ids, -similarity))[:count]]]


def describe(descriptors: np.ndarray) -> np.ndarray:
    """(C,) float32 of unit length, alike for descriptors (N, D) of one place; C = 0 where D = 0."""
    descriptors = descriptors[:_FEATURES]
    if descriptors.shape[1] > _DIMENSIONS:
        projection = np.random.default_rng(0).normal(size=(descriptors.shape[1], _DIMENSIONS))
        descriptors = descriptors @ projection.astype(np.float32)
    row, column = np.triu_indices(descriptors.shape[1])
    # Entries beside the diagonal stand for two.
    moment = (descriptors.T @ descriptors)[row, column] * np.where(row == column, 1.0, 2.0)
    vector = np.sign(moment) * np.sqrt(np.abs(moment))
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12), np.float32)
