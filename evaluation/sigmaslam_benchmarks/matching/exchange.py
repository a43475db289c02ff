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

Find = Callable[[np.ndarray, int], np.ndarray]
"""Keypoints (N, 2) of an image (H, W) uint8, at most so many."""
Describe = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Unit descriptors (N, C) of keypoints (N, 2) of an image (H, W) uint8."""
Exchanged = Mapping[tuple[str, str], KeypointsAndDescriptors]
"""By whose the keypoints and whose the descriptors are."""


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
    names = {
        "ours": str(shipped_weights("features.onnx")),
        **{each.stem: str(each) for each in weights},
        "sift": "sift",
    }
    finders, describers = _peer(checkout)
    tables = {}
    with open_progress() as progress:
        for name in sets:
            pairs = SETS[name](data)
            task = progress.add_task(name, total=len(pairs), note="")
            scores: dict[tuple[str, str, str], list[ExchangeScore]] = {}
            images = {id(image): image for pair in pairs for image in (pair.image0, pair.image1)}
            found: dict[int, Exchanged] = {}
            for pair in pairs:
                both = id(pair.image0), id(pair.image1)
                found |= {k: exchange(images[k], names, finders, describers) for k in both if k not in found}
                features0, features1 = (found[k] for k in both)
                for whose in features0:
                    score = score_exchange(pair, features0[whose], features1[whose])
                    scores.setdefault((pair.part, *whose), []).append(score)
                progress.advance(task)
            tables[name] = [
                [part, str(len(each)), *whose, *(number(mean, ".0f") for mean in np.mean(each, axis=0))]
                for (part, *whose), each in sorted(scores.items(), key=lambda item: item[0][0])
            ]
    return write_page(path, fill_page("exchange", command, tables=tables, pixels=_PIXELS))


def exchange(
    image: np.ndarray, names: Mapping[str, str], finders: Mapping[str, Find], describers: Mapping[str, Describe]
) -> Exchanged:
    """All keypoints of an image with all descriptors.

    Args:
        names: of extractors, as `load_extractor` takes them; they also have descriptors of their own.
    """
    count = min(MAX_KEYPOINTS, image.size // _PIXELS)
    found = {(name, "own"): load_extractor(extractor, count)(image) for name, extractor in names.items()}
    keypoints = {name: points for (name, _), (points, _) in found.items()}
    keypoints |= {name: find(image, count) for name, find in finders.items()}
    exchanged = {
        (who, whose): (keypoints[who], describers[whose](image, keypoints[who]))
        for who in keypoints
        for whose in describers
    }
    return found | exchanged


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


def _peer(checkout: Path | None) -> tuple[dict[str, Find], dict[str, Describe]]:
    """Who finds keypoints alone, and who describes any: our network, from the full scale alone, and EdgePoint2."""
    network = load_network(shipped_weights("features.safetensors"))

    @torch.inference_mode()
    def describe(image: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
        points = torch.from_numpy(keypoints.astype(np.float32))
        return np.asarray(network.describe(network(to_cells(_padded(image))), points[None])[0].numpy())

    if checkout is None:
        return {}, {"ours": describe}
    peer = load_edgepoint2(checkout)

    @torch.inference_mode()
    def find(image: np.ndarray, count: int) -> np.ndarray:
        places, scores, _ = (each.numpy() for each in peer(_padded(image)))
        return np.asarray(places[(scores > 0) & (places <= np.array(image.shape[::-1]) - 1).all(axis=1)][:count])

    @torch.inference_mode()
    def describe_peer(image: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
        padded, points = _padded(image), torch.from_numpy(keypoints.astype(np.float32))
        return np.asarray(peer.describe(padded, peer.network(padded)[0], points).numpy())

    return {_PEER: find}, {"ours": describe, _PEER: describe_peer}


def _padded(image: np.ndarray) -> torch.Tensor:
    bottom, right = (-side % _MULTIPLE for side in image.shape)
    padded = cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REPLICATE)
    return torch.from_numpy(padded)[None, None].float() / 255.0
