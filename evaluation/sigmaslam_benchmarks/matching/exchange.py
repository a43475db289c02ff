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
from sigmaslam_benchmarks.matching.peer_exports import load_edgepoint2
from sigmaslam_benchmarks.matching.scores import KeypointsAndDescriptors, match_judged, mutual_nearest
from sigmaslam_benchmarks.matching.wide_pairs import WidePair
from sigmaslam_benchmarks.tracking.page import fill_page, number, write_page
from sigmaslam_models.detector import to_cells
from sigmaslam_models.network_export import load_network

SETS = {"fountain": wide_pairs.fountain, "euroc": wide_pairs.euroc, "renders": wide_pairs.renders}
_PEER = "edgepoint2"
_MULTIPLE = 32  # of sides, which all networks take
# A keypoint for so many pixels: at most 1,024 in an image of 640x410 and more.
_PIXELS = 256
_NEAR, _FAR = 1.0, 3.0

Describe = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Unit descriptors (N, C) of keypoints (N, 2) of an image (H, W) uint8."""


class ExchangeScore(NamedTuple):
    """Numbers of a pair: keypoints and matches, as the page describes them; NaN where they are not known."""

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
    find, describers = _extractors(weights, checkout)
    tables = {}
    with open_progress() as progress:
        for name in sets:
            pairs = SETS[name](data)
            task = progress.add_task(name, total=len(pairs), note="")
            scores: dict[tuple[str, str, str], list[ExchangeScore]] = {}
            images = {id(image): image for pair in pairs for image in (pair.image0, pair.image1)}
            found: dict[int, dict[tuple[str, str], KeypointsAndDescriptors]] = {}
            for pair in pairs:
                both = id(pair.image0), id(pair.image1)
                found |= {k: _exchange(images[k], find(images[k]), describers) for k in both if k not in found}
                for whose, features0 in found[both[0]].items():
                    score = score_exchange(pair, features0, found[both[1]][whose])
                    scores.setdefault((pair.part, *whose), []).append(score)
                progress.advance(task)
            tables[name] = [
                [part, str(len(each)), *whose, *(number(mean, ".0f") for mean in np.mean(each, axis=0))]
                for (part, *whose), each in sorted(scores.items(), key=lambda item: item[0][0])
            ]
    return write_page(path, fill_page("exchange", command, tables=tables, pixels=_PIXELS))


def _exchange(
    image: np.ndarray, found: Mapping[str, KeypointsAndDescriptors], describers: Mapping[str, Describe]
) -> dict[tuple[str, str], KeypointsAndDescriptors]:
    """All keypoints with all descriptors, by whose the keypoints and whose the descriptors are."""
    own = {(name, "own"): features for name, features in found.items()}
    described = {
        (name, whose): (features[0], describe(image, features[0]))
        for name, features in found.items()
        for whose, describe in describers.items()
    }
    return own | described


def score_exchange(
    pair: WidePair, features0: KeypointsAndDescriptors, features1: KeypointsAndDescriptors
) -> ExchangeScore:
    """What keypoints and descriptors of both images achieve on a pair."""
    places, seen = pair.transfer(features0[0].astype(np.float64))
    distance = np.full((len(places), len(features1[0])), np.inf)
    distance[seen] = np.linalg.norm(places[seen, None] - features1[0][None], axis=2)
    matches = match_judged(pair.image0, pair.image1, features0, features1)
    off = np.linalg.norm(matches.keypoints1 - places[matches.index0], axis=1)
    lines = np.nan
    if pair.motion is not None:
        lines = float((pair.motion.epipolar_distance(matches.keypoints0, matches.keypoints1) < _NEAR).sum())
    return ExchangeScore(
        float(seen.sum()),
        count_partners(distance < _NEAR),
        count_partners(distance < _FAR),
        float((distance[mutual_nearest(features0[1], features1[1])] < _FAR).sum()),
        float(((off < _FAR) & seen[matches.index0]).sum()),
        lines,
    )


def count_partners(near: np.ndarray) -> int:
    """Most pairs, one to one, of rows and columns that are near each other, (N, M) bool."""
    return int((maximum_bipartite_matching(csr_matrix(near), perm_type="column") >= 0).sum())


def _extractors(
    weights: Sequence[Path], checkout: Path | None
) -> tuple[Callable[[np.ndarray], dict[str, KeypointsAndDescriptors]], dict[str, Describe]]:
    """What finds the features of everyone in an image, and who describes any keypoints."""
    network = load_network(shipped_weights("features.safetensors"))
    peer = None if checkout is None else load_edgepoint2(checkout)
    names = {
        "ours": str(shipped_weights("features.onnx")),
        "sift": "sift",
        **{each.stem: str(each) for each in weights},
    }

    @torch.inference_mode()
    def describe(image: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
        points = torch.from_numpy(keypoints.astype(np.float32))
        return np.asarray(network.describe(network(to_cells(_padded(image))), points[None])[0].numpy())

    @torch.inference_mode()
    def describe_peer(image: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
        assert peer is not None
        padded, points = _padded(image), torch.from_numpy(keypoints.astype(np.float32))
        return np.asarray(peer.describe(padded, peer.network(padded)[0], points).numpy())

    @torch.inference_mode()
    def find(image: np.ndarray) -> dict[str, KeypointsAndDescriptors]:
        count = min(MAX_KEYPOINTS, image.size // _PIXELS)
        found = {name: load_extractor(extractor, count)(image) for name, extractor in names.items()}
        if peer is not None:
            places, scores, descriptors = (each.numpy() for each in peer(_padded(image)))
            kept = np.flatnonzero((scores > 0) & (places <= np.array(image.shape[::-1]) - 1).all(axis=1))[:count]
            found[_PEER] = places[kept], descriptors[kept]
        return found

    return find, {"ours": describe} if peer is None else {"ours": describe, _PEER: describe_peer}


def _padded(image: np.ndarray) -> torch.Tensor:
    bottom, right = (-side % _MULTIPLE for side in image.shape)
    padded = cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REPLICATE)
    return torch.from_numpy(padded)[None, None].float() / 255.0
