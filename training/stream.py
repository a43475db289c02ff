"""Training pairs as a torch data set: item i is a function of (seed, i) alone."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from sigmaslam.synthetic.pairs import HomographyPairs

# image0 (1, H, W), image1 (1, H, W), H_1_0 (3, 3), corners0 (N, 2), corners1 (N, 2); all float32
TrainingPair = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]


class PairDataset(Dataset[TrainingPair]):
    """Pairs `first` to `last` of a stream, each with N random corners of either image.

    Args:
        seed: of the stream.
        size: side of the square images, pixels.
        first, last: range of indices, so that a resumed run goes on where it stopped.
        corners: N, corners per image; random places fill up where an image has fewer.
    """

    def __init__(self, seed: int, size: int, first: int, last: int, corners: int) -> None:
        self._pairs = HomographyPairs(seed, size)
        self._seed, self._size = seed, size
        self._first, self._last = first, last
        self._corners = corners

    def __len__(self) -> int:
        return self._last - self._first

    def __getitem__(self, item: int) -> TrainingPair:
        if not 0 <= item < len(self):
            raise IndexError(item)
        index = self._first + item
        pair = self._pairs.pair(index)
        rng = np.random.default_rng((self._seed, 2, index))
        return (
            torch.from_numpy(pair.image0)[None],
            torch.from_numpy(pair.image1)[None],
            torch.from_numpy(pair.H_1_0.astype(np.float32)),
            torch.from_numpy(self._some_corners(pair.image0, rng)),
            torch.from_numpy(self._some_corners(pair.image1, rng)),
        )

    def _some_corners(self, image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """A random choice among twice as many corners, so that weak ones are learned too: (N, 2) float32."""
        found = cv2.goodFeaturesToTrack(image, 2 * self._corners, 1e-3, 3.0, blockSize=5)
        places = np.zeros((0, 2), np.float32) if found is None else found.reshape(-1, 2)
        chosen = rng.permutation(places)[: self._corners]
        filling = rng.uniform(0, self._size - 1, (self._corners - len(chosen), 2))
        return np.concatenate([chosen, filling]).astype(np.float32)


def pair_loader(
    seed: int, size: int, first: int, last: int, corners: int, batch_size: int, workers: int
) -> DataLoader[TrainingPair]:
    """Batches of pairs in order of their index."""
    return DataLoader(
        PairDataset(seed, size, first, last, corners),
        batch_size=batch_size,
        num_workers=workers,
        worker_init_fn=_one_thread if workers else None,
        prefetch_factor=4 if workers else None,
    )


def _one_thread(worker: int) -> None:
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
