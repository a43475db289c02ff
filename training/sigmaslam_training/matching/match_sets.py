"""What the match scorer learns from: putative matches of rendered pairs, with the error of each."""

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np

from sigmaslam.errors import SigmaSlamError
from sigmaslam.files import atomic_path, make_folder
from sigmaslam.frontend.classical import OrbDetector, SiftDetector
from sigmaslam.frontend.learned import LearnedDetector
from sigmaslam.frontend.nearest_neighbours import (
    Putative,
    nearest_among_pairs,
    nearest_anywhere,
    nearest_in_ellipses,
    pairs_in_band,
)
from sigmaslam.frontend.types import Features
from sigmaslam_synthetic.homography_pairs import HomographyPairs
from sigmaslam_synthetic.rendering.textures import KINDS
from sigmaslam_synthetic.scene_pairs import ScenePairs
from sigmaslam_training.features.stream import PairStream, prepare_worker, take_turn

DETECTORS: dict[str, Callable[[int], Callable[[np.ndarray], Features]]] = {
    "learned": lambda count: LearnedDetector(count, threads=1),
    "sift": SiftDetector,
    "orb": OrbDetector,
}
SIZE = 384
"""Side of the square images, pixels."""
# Keypoints an image, drawn evenly in the logarithm: those of 0.3 to 2.5 thousand in an image of 640 x 480 pixels.
_KEYPOINTS = (150, 1200)
_MIN_MATCHES = 24
# In turn; "anywhere" is as between two photographs, "rows" as in a stereo pair, "ellipses" as with a prediction.
_TURNS = ("planes", "scenes", "stereo", "scenes", "turned planes", "video")
_ROW_TOLERANCE = 2.0
_DISPARITY = (-2.0, 0.25 * SIZE)
_ELLIPSE_SIGMA = (1.0, 25.0)
# Standard deviation, in pixels, of a prediction whose true place is unknown.
_FOREIGN = 40.0
_POLL = 0.5  # seconds
_OWN = ("source", "expected", "visible")
_PUTATIVE = ("index0", "index1", "similarity", "second0", "second1")


@dataclass(frozen=True, slots=True)
class MatchSet:
    """Putative matches of one pair by one kind of features.

    Attributes:
        source: one of the turns, for reports.
        features0, features1: of the images, without descriptors.
        putative: for every keypoint of image 0 that has a candidate.
        expected: (N, 2) where the geometry has each keypoint of image 0 in image 1, also if it is hidden there.
        visible: (N,) bool, whether it is seen there.
    """

    source: str
    features0: Features
    features1: Features
    putative: Putative
    expected: np.ndarray
    visible: np.ndarray

    @property
    def places(self) -> np.ndarray:
        """(M, 2) true places of the putative matches in image 1, infinite where they are not seen there."""
        return np.where(self.visible[:, None], self.expected, np.inf)[self.putative.index0]


@dataclass(frozen=True, slots=True)
class PairRecord:
    """A rendered pair as (H, W) uint8 images, and its match sets by kind of features."""

    image0: np.ndarray
    image1: np.ndarray
    sets: dict[str, MatchSet]


class MatchSets:
    """Random access to pairs with their matches; a record is a function of (seed, index).

    Args:
        seed: of the pairs.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._streams: dict[str, PairStream] = {
            "planes": HomographyPairs(seed, SIZE, KINDS, (0.5, 1.0)),
            "turned planes": HomographyPairs(seed + 1, SIZE, ("leaves",), (1.0, 1.25)),
            "scenes": ScenePairs(seed, SIZE),
            "video": HomographyPairs(seed + 2, SIZE, ("leaves",), (0.1, 0.2)),
            "stereo": ScenePairs(seed + 1, SIZE, stereo=True),
        }

    def record(self, index: int) -> PairRecord:
        """The record of that index, the same whenever it is asked for."""
        source, source_index = take_turn(_TURNS, index)
        pair = self._streams[source].pair(source_index)
        rng = np.random.default_rng((self._seed, 3, index))
        image0, image1 = (np.round(255.0 * image).astype(np.uint8) for image in (pair.image0, pair.image1))
        count = int(np.exp(rng.uniform(*np.log(_KEYPOINTS))))
        guided = rng.random() < 0.4
        sets = {}
        for kind, make in DETECTORS.items():
            detect = make(count)
            features0, features1 = detect(image0), detect(image1)
            places, visible = pair.transfer(features0.keypoints.astype(np.float64))
            putative = _match(source, guided, features0, features1, places, rng)
            if len(putative.index0) >= _MIN_MATCHES:
                sets[kind] = MatchSet(source, _bare(features0), _bare(features1), putative, places, visible)
        return PairRecord(image0, image1, sets)


def nearest_in_rows(
    left: np.ndarray,
    right: np.ndarray,
    descriptors_left: np.ndarray,
    descriptors_right: np.ndarray,
    row_tolerance: float,
    disparity_range: tuple[float, float],
) -> Putative:
    """Nearest neighbours along the rows of a rectified pair.

    Args:
        left, right: (N, 2), (M, 2) keypoints.
        descriptors_left, descriptors_right: (N, D), (M, D) of unit length.
        row_tolerance: largest |v_left - v_right|, pixels.
        disparity_range: allowed u_left - u_right, pixels.
    """
    first, second = pairs_in_band(left[:, 1], np.full(len(left), row_tolerance), right[:, 1])
    disparity = left[first, 0] - right[second, 0]
    allowed = (disparity >= disparity_range[0]) & (disparity <= disparity_range[1])
    return nearest_among_pairs(descriptors_left, descriptors_right, first[allowed], second[allowed])


def _match(
    source: str, guided: bool, features0: Features, features1: Features, places: np.ndarray, rng: np.random.Generator
) -> Putative:
    descriptors = features0.descriptors, features1.descriptors
    if source == "stereo":
        return nearest_in_rows(features0.keypoints, features1.keypoints, *descriptors, _ROW_TOLERANCE, _DISPARITY)
    if guided and source in ("scenes", "video"):
        sigma = np.exp(rng.uniform(*np.log(_ELLIPSE_SIGMA)))
        valid = (np.abs(places) < 4 * SIZE).all(axis=1)
        predicted = np.where(valid[:, None], places, features0.keypoints + rng.normal(0.0, _FOREIGN, places.shape))
        predicted = predicted + sigma * rng.standard_normal(2)
        covariance = np.tile(sigma**2 * np.eye(2), (len(predicted), 1, 1))
        return nearest_in_ellipses(predicted, covariance, features1.keypoints, *descriptors)
    return nearest_anywhere(*descriptors)


def _bare(features: Features) -> Features:
    """Without descriptors, which the scorer does not see."""
    return Features(features.keypoints, features.descriptors[:, :0], features.scores, features.sigma)


def save_record(path: Path, record: PairRecord) -> None:
    """Writes a record as .npz."""
    arrays = {"image0": record.image0, "image1": record.image1}
    for kind, match_set in record.sets.items():
        arrays |= {f"{kind}.{name}": np.array(getattr(match_set, name)) for name in _OWN}
        for name in ("keypoints", "scores", "sigma"):
            arrays[f"{kind}.{name}0"] = getattr(match_set.features0, name)
            arrays[f"{kind}.{name}1"] = getattr(match_set.features1, name)
        for name in _PUTATIVE:
            arrays[f"{kind}.{name}"] = getattr(match_set.putative, name)
    with atomic_path(path) as temporary:
        np.savez(temporary, allow_pickle=False, **arrays)


def load_record(path: Path) -> PairRecord:
    """Reads what `save_record` wrote."""
    with np.load(path) as arrays:
        sets = {}
        for kind in DETECTORS:
            if f"{kind}.source" not in arrays:
                continue
            of_kind = {name.removeprefix(f"{kind}."): arrays[name] for name in arrays if name.startswith(f"{kind}.")}
            features = []
            for k in (0, 1):
                keypoints, scores, sigma = (of_kind[f"{name}{k}"] for name in ("keypoints", "scores", "sigma"))
                features.append(Features(keypoints, np.zeros((len(keypoints), 0), np.float32), scores, sigma))
            putative = Putative(*(of_kind[name] for name in _PUTATIVE))
            source, expected, visible = str(of_kind["source"]), of_kind["expected"], of_kind["visible"]
            sets[kind] = MatchSet(source, features[0], features[1], putative, expected, visible)
        return PairRecord(arrays["image0"], arrays["image1"], sets)


def write_records(folder: Path, seed: int, pairs: int, workers: int) -> Iterator[int]:
    """Makes the records that a folder lacks; after each of them their number so far is given.

    Args:
        folder: of the files, NNNNN.npz.
        seed: of `MatchSets`.
        pairs: how many are wanted.
    """
    make_folder(folder)
    missing = [index for index in range(pairs) if not record_path(folder, index).is_file()]
    yield pairs - len(missing)
    # Neighbouring pairs share their scenes: each process gets a range of them.
    shares = [share for share in np.array_split(missing, workers) if len(share)]
    if not shares:
        return
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=_write_share, args=(folder, seed, share.tolist())) for share in shares]
    try:
        for process in processes:
            process.start()
        while alive := [process.sentinel for process in processes if process.is_alive()]:
            wait(alive, _POLL)
            _check_alive(processes, folder)
            yield sum(record_path(folder, index).is_file() for index in range(pairs))
        _check_alive(processes, folder)
    finally:
        for process in processes:
            process.terminate()
    yield pairs


def _check_alive(processes: Sequence[BaseProcess], folder: Path) -> None:
    if any(process.exitcode for process in processes):
        raise SigmaSlamError(f"a process that makes pairs in {folder} died: run the same command again")


def record_path(folder: Path, index: int) -> Path:
    """Where `write_records` puts a record."""
    return folder / f"{index:05d}.npz"


def _write_share(folder: Path, seed: int, share: list[int]) -> None:
    prepare_worker(0)
    records = MatchSets(seed)
    for index in share:
        save_record(record_path(folder, index), records.record(index))
