"""Training pairs as a torch data set: item i is a function of (seed, i) alone."""

import signal
from typing import Protocol

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Subset

from sigmaslam_models.detector import detect, to_cells
from sigmaslam_synthetic.homography_pairs import HomographyPairs
from sigmaslam_synthetic.rendering.textures import KINDS
from sigmaslam_synthetic.scene_pairs import ScenePairs
from sigmaslam_synthetic.worlds.own import SUFFIX
from sigmaslam_training.features.recipes import TrainingConfig
from sigmaslam_training.sources import WORLDS, Mix, label, turns_of

# image0 (1, H, W), image1 (1, H, W), keypoints0 (N, 2), places1 (N, 2), visible (N,), keypoints1 (2 N, 2)
TrainingPair = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]

NOWHERE = -1000.0
"""Both coordinates of a keypoint that fills up."""


class Pair(Protocol):
    """Two images and where points of the first lie in the second."""

    @property
    def image0(self) -> np.ndarray:
        """(H, W) float32 in [0, 1]."""

    @property
    def image1(self) -> np.ndarray:
        """(H, W) float32 in [0, 1]."""

    def transfer(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places (N, 2) in image 1 of points (N, 2) of image 0, and whether they are seen there (N,) bool."""


class PairStream(Protocol):
    """Random access to pairs."""

    def pair(self, index: int) -> Pair:
        """The pair of that index, the same whenever it is asked for."""


def open_stream(source: str, seed: int, size: int) -> PairStream:
    """A stream by name.

    'scenes', 'endoscopy' (scenes inside a body), the name of a world or a Python file that makes one, 'patterns' (every
    texture but leaves), a texture's kind or a folder of photographs under homographies, or 'turned leaves', which are
    warped further: by up to 90 degrees and e^1 between the views.
    """
    # Derive a seed for each source: sources with the same kind of texture must show different ones.
    seed = int(np.random.SeedSequence((seed, *label(source).encode())).generate_state(1)[0])
    if source == "scenes":
        return ScenePairs(seed, size)
    if source == "endoscopy":
        return ScenePairs(seed, size, ("colon", "organ"))
    if source in WORLDS or source.endswith(SUFFIX):
        return ScenePairs(seed, size, (source,))
    if source == "turned leaves":
        return HomographyPairs(seed, size, ("leaves",), (1.0, 1.25))
    kinds = tuple(kind for kind in KINDS if kind != "leaves") if source == "patterns" else (source,)
    return HomographyPairs(seed, size, kinds)


def take_turn(turns: tuple[str, ...], index: int) -> tuple[str, int]:
    """Whose turn it is at that index, and its own index among its pairs.

    Each source sees neighbouring numbers, so that its textures and scenes are used as often as they should be.
    """
    lap, turn = divmod(index, len(turns))
    source = turns[turn]
    return source, lap * turns.count(source) + turns[:turn].count(source)


class MixedPairs:
    """Pairs of several sources in turn.

    Args:
        mix: as `sources.turns_of` takes it.
        seed: of all sources.
        size: side of the square images, pixels.
    Raises:
        InputError: the mix is unknown.
    """

    def __init__(self, mix: Mix, seed: int, size: int) -> None:
        self._turns = turns_of(mix)
        self._streams = {source: open_stream(source, seed, size) for source in set(self._turns)}

    def pair(self, index: int) -> Pair:
        """The pair of that index, the same whenever it is asked for."""
        source, source_index = take_turn(self._turns, index)
        return self._streams[source].pair(source_index)


class PairDataset(Dataset[TrainingPair]):
    """The pairs of a run, each with N random keypoints of image 0 and the 2 N strongest of image 1.

    Args:
        config: of the run, with N as `points`; random places fill up where an image has fewer, in image 1 places far
            outside.
        done: steps whose pairs are left out, so that a resumed run goes on where it stopped.
    """

    def __init__(self, config: TrainingConfig, done: int) -> None:
        self._pairs = MixedPairs(config.mix, config.seed, config.size)
        self._config, self._first = config, done * config.batch_size

    def __len__(self) -> int:
        return self._config.steps * self._config.batch_size - self._first

    def __getitem__(self, item: int) -> TrainingPair:
        if not 0 <= item < len(self):
            raise IndexError(item)
        index, count = self._first + item, self._config.points
        pair = self._pairs.pair(index)
        rng = np.random.default_rng((self._config.seed, 2, index))
        # Choose keypoints of image 0 at random, to learn weak ones too, and keep all of image 1, to keep the partners.
        keypoints0 = rng.permutation(self._strongest(pair.image0))[:count]
        filling = rng.uniform(0, self._config.size - 1, (count - len(keypoints0), 2))
        keypoints0 = np.concatenate([keypoints0, filling]).astype(np.float32)
        keypoints1 = self._strongest(pair.image1)
        keypoints1 = np.pad(keypoints1, ((0, 2 * count - len(keypoints1)), (0, 0)), constant_values=NOWHERE)
        places1, visible = pair.transfer(keypoints0)
        return (
            torch.from_numpy(pair.image0)[None],
            torch.from_numpy(pair.image1)[None],
            torch.from_numpy(keypoints0),
            torch.from_numpy(places1.astype(np.float32)),
            torch.from_numpy(visible),
            torch.from_numpy(keypoints1),
        )

    def _strongest(self, image: np.ndarray) -> np.ndarray:
        """At most 2 N keypoints, (K, 2) float32, the strongest first."""
        keypoints, strength = detect(to_cells(torch.from_numpy(image)[None, None]), 2 * self._config.points)
        return np.asarray(keypoints[strength > 0].numpy())


def pair_loader(
    config: TrainingConfig, done: int, workers: int, rank: int = 0, ranks: int = 1, pinned: bool = False
) -> DataLoader[TrainingPair]:
    """Batches of pairs in order of their index.

    Args:
        config: of the run; batches are of a multiple of `ranks` pairs.
        done: steps whose batches are left out.
        workers: processes that make pairs.
        rank, ranks: this process takes pairs rank, rank + ranks, ... of every batch.
        pinned: batches lie where a GPU can fetch them.
    """
    dataset = PairDataset(config, done)
    return DataLoader(
        Subset(dataset, range(rank, len(dataset), ranks)),
        batch_size=config.batch_size // ranks,
        num_workers=workers,
        worker_init_fn=prepare_worker if workers else None,
        # A fork of a process that has used OpenCV or torch may wait for ever for threads that it lacks.
        multiprocessing_context="spawn" if workers else None,
        prefetch_factor=4 if workers else None,
        pin_memory=pinned,
    )


def prepare_worker(worker: int) -> None:
    """What a process that makes pairs does first."""
    # Ctrl-C reaches every process of the terminal: the one that trains ends its workers itself.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
