"""The exchange: keypoints of one extractor with the descriptors of another, matched alike between wide baselines.

It tells which of the two loses matches.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import maximum_bipartite_matching

from sigmaslam.inference.onnx_graph import shipped_weights
from sigmaslam.progress import open_progress
from sigmaslam_benchmarks.matching import wide_pairs
from sigmaslam_benchmarks.matching.extractors import MAX_KEYPOINTS, load_extractor
from sigmaslam_benchmarks.matching.peer_exports import EdgePoint2Extractor, load_edgepoint2
from sigmaslam_benchmarks.matching.scores import KeypointsAndDescriptors, match_judged, mutual_nearest
from sigmaslam_benchmarks.matching.wide_pairs import WidePair
from sigmaslam_benchmarks.tracking.page import fill_page, write_page
from sigmaslam_models.detector import to_cells
from sigmaslam_models.feature_network import FeatureNetwork
from sigmaslam_models.network_export import load_network

SETS = {"fountain": wide_pairs.fountain, "euroc": wide_pairs.euroc, "renders": wide_pairs.renders}
OURS, PEER, SIFT = "ours", "edgepoint2", "sift"
_MULTIPLE = 32
# A keypoint for so many pixels: at most 1,024 in an image of 640x410 and more.
_PIXELS = 256
_NEAR, _FAR = 1.0, 3.0

Extract = Callable[[np.ndarray], KeypointsAndDescriptors]
Describe = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Unit descriptors (N, C) of keypoints (N, 2) of an image (H, W) uint8."""


class ExchangeScore(NamedTuple):
    """Of one pair, numbers of keypoints and of matches.

    Attributes:
        known: keypoints of image 0 whose place in image 1 is known and seen.
        repeated_1, repeated_3: most of them that have a keypoint of their own within 1 and 3 px of their place: no
            matcher finds more.
        mutual: mutual nearest neighbours within 3 px.
        right: of what `sigmaslam match` makes of them in two rounds, those within 3 px ...
        near_lines: ... and those within 1 px of their true epipolar line, NaN where parts of the scene move.
    """

    known: float
    repeated_1: float
    repeated_3: float
    mutual: float
    right: float
    near_lines: float


def write_exchange(
    path: Path, data: Path, command: str, weights: Sequence[Path], checkout: Path | None, sets: Sequence[str]
) -> str:
    """Scores all exchanges on the sets, writes the page and returns it; notes in it are kept.

    Args:
        weights: ours, beside the shipped ones; .safetensors or .onnx.
        checkout: of EdgePoint2, see `peer_exports`; None: without it.
        sets: of SETS.
    """
    network = load_network(shipped_weights("features.safetensors"))
    describers: dict[str, Describe] = {OURS: lambda image, keypoints: describe_ours(network, image, keypoints)}
    names = {OURS: str(shipped_weights("features.onnx")), **{each.stem: str(each) for each in weights}, SIFT: SIFT}
    peer = None if checkout is None else load_edgepoint2(checkout)
    if peer is not None:
        describers[PEER] = lambda image, keypoints: describe_peer(peer, image, keypoints)
    tables = {}
    with open_progress() as progress:
        for name in sets:
            pairs = SETS[name](data)
            task = progress.add_task(name, total=len(pairs), note="")
            scores: dict[tuple[str, str, str], list[ExchangeScore]] = {}
            remembered: dict[int, tuple[np.ndarray, dict[tuple[str, str], KeypointsAndDescriptors]]] = {}
            for pair in pairs:
                for image in (pair.image0, pair.image1):
                    if id(image) not in remembered:
                        remembered[id(image)] = image, exchange(image, names, describers, peer)
                features0, features1 = remembered[id(pair.image0)][1], remembered[id(pair.image1)][1]
                for whose in features0:
                    scores.setdefault((pair.part, *whose), []).append(
                        score_exchange(pair, features0[whose], features1[whose])
                    )
                progress.advance(task)
            tables[name] = [
                _row(*key, of_pairs) for key, of_pairs in sorted(scores.items(), key=lambda each: each[0][0])
            ]
    return write_page(path, fill_page("exchange", command, tables=tables, pixels=_PIXELS))


def exchange(
    image: np.ndarray, names: Mapping[str, str], describers: Mapping[str, Describe], peer: EdgePoint2Extractor | None
) -> dict[tuple[str, str], KeypointsAndDescriptors]:
    """All keypoints of an image with all descriptors, by whose the keypoints and whose the descriptors are."""
    count = min(MAX_KEYPOINTS, image.size // _PIXELS)
    found: dict[tuple[str, str], KeypointsAndDescriptors] = {}
    keypoints = {}
    for name, extractor in names.items():
        features = load_extractor(extractor, count)(image)
        found[name, "own"], keypoints[name] = features, features[0]
    if peer is not None:
        with torch.inference_mode():
            places, scores, _ = (each.numpy() for each in peer(_padded(image)))
        inside = (scores > 0) & (places <= np.array(image.shape[::-1]) - 1).all(axis=1)
        keypoints[PEER] = places[inside][:count]
    for name, points in keypoints.items():
        for describer, describe in describers.items():
            found[name, describer] = points, describe(image, points)
    return found


def describe_ours(network: FeatureNetwork, image: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    """Our descriptors at any keypoints, from the image at its full scale alone."""
    with torch.inference_mode():
        maps = network(to_cells(_padded(image)))
        return np.asarray(network.describe(maps, torch.from_numpy(keypoints.astype(np.float32))[None])[0].numpy())


def describe_peer(peer: EdgePoint2Extractor, image: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    """EdgePoint2's descriptors at any keypoints."""
    with torch.inference_mode():
        padded = _padded(image)
        points = torch.from_numpy(keypoints.astype(np.float32))
        return np.asarray(peer.describe(padded, peer.network(padded)[0], points).numpy())


def score_exchange(
    pair: WidePair, features0: KeypointsAndDescriptors, features1: KeypointsAndDescriptors
) -> ExchangeScore:
    """What keypoints and descriptors of both images achieve on a pair."""
    places, seen = pair.transfer(features0[0].astype(np.float64))
    distance = np.full((len(places), len(features1[0])), np.inf)
    distance[seen] = np.linalg.norm(places[seen, None] - features1[0][None], axis=2)
    index0, index1 = mutual_nearest(features0[1], features1[1])
    matches = match_judged(pair.image0, pair.image1, features0, features1)
    right = np.linalg.norm(matches.keypoints1 - places[matches.index0], axis=1) < _FAR
    lines = np.nan
    if pair.motion is not None:
        lines = float((pair.motion.epipolar_distance(matches.keypoints0, matches.keypoints1) < _NEAR).sum())
    return ExchangeScore(
        float(seen.sum()),
        count_partners(distance < _NEAR),
        count_partners(distance < _FAR),
        float((distance[index0, index1] < _FAR).sum()),
        float((right & seen[matches.index0]).sum()),
        lines,
    )


def count_partners(near: np.ndarray) -> int:
    """Most pairs, one to one, of rows and columns that are near each other, (N, M) bool."""
    return int((maximum_bipartite_matching(csr_matrix(near), perm_type="column") >= 0).sum())


def _padded(image: np.ndarray) -> torch.Tensor:
    bottom, right = (-side % _MULTIPLE for side in image.shape)
    padded = cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REPLICATE)
    return torch.from_numpy(padded)[None, None].float() / 255.0


def _row(part: str, keypoints: str, descriptors: str, scores: Sequence[ExchangeScore]) -> list[str]:
    means = [float(mean) for mean in np.mean(scores, axis=0)]
    return [
        part,
        str(len(scores)),
        keypoints,
        descriptors,
        *("-" if np.isnan(mean) else f"{mean:.0f}" for mean in means),
    ]
