"""A vocabulary for ORB-SLAM3, trained on renders, where its own (139 MB, of photographs) cannot be had.

    python -m sigmaslam_benchmarks.tracking.orb_vocabulary orb_vocabulary.txt --runs build/results
    export PYORBSLAM3_VOCAB=$PWD/orb_vocabulary.txt

A tree of ten branches and six levels as in Galvez-Lopez and Tardos (2012), "Bags of Binary Words for Fast Place
Recognition in Image Sequences": the centre of a branch is the majority of each bit. Branches end early where few
descriptors are left. The renders are of seeds that no benchmark tracks.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_write_text
from sigmaslam.readers import open_sequence

# As in ORB-SLAM3's own vocabulary; it groups features by the nodes of the second level.
BRANCHES, LEVELS = 10, 6
_GROUPED = 2
_PRESETS, _SEEDS, _FRAMES = ("street", "room", "drone", "organ", "rubble"), (5000, 5001), 20
# As in ORB-SLAM3's settings.
_KEYPOINTS, _FACTOR, _OCTAVES = 1200, 1.2, 8
_ROUNDS = 10  # of k-medians; few clusters change later
_SEED = 0


def train_vocabulary(images: Sequence[np.ndarray]) -> str:
    """A vocabulary in the text form of DBoW2, which ORB-SLAM3 reads.

    The first line has branches, levels, scoring (0: L1) and weighting (0: TF-IDF). The others have a node each: its
    parent (0: the root), whether it is a word, its 32 bytes, and its weight, the logarithm of the number of images
    over that of the images with the word.

    Args:
        images: (H, W) uint8 each.
    Returns:
        The text, without a line break at its end, which DBoW2 would take for one more node.
    Raises:
        InputError: fewer than 1,000 descriptors are found.
    """
    orb = cv2.ORB.create(_KEYPOINTS, _FACTOR, _OCTAVES)
    found = [orb.detectAndCompute(image, None)[1] for image in images]
    found = [np.zeros((0, 32), np.uint8) if each is None else each for each in found]
    descriptors, image = np.concatenate(found), np.repeat(np.arange(len(found)), [len(each) for each in found])
    if len(descriptors) < BRANCHES ** (_GROUPED + 1):
        raise InputError(
            f"{len(images)} images have {len(descriptors)} descriptors: give more, a vocabulary needs "
            f"{BRANCHES ** (_GROUPED + 1)}"
        )
    lines = [f"{BRANCHES} {LEVELS} 0 0"]
    generator = np.random.default_rng(_SEED)
    for parent, centre, members in _nodes(descriptors, generator):
        is_word = members is not None
        weight = np.log(len(images) / len(np.unique(image[members]))) if is_word else 0.0
        lines.append(f"{parent} {int(is_word)} {' '.join(map(str, centre))} {weight:.6g}")
    return "\n".join(lines)


def _nodes(
    descriptors: np.ndarray, generator: np.random.Generator
) -> Iterator[tuple[int, np.ndarray, np.ndarray | None]]:
    """Parent, centre (32,) and, of a word, the rows of its descriptors, for each node, parents before children."""
    open_nodes, number = [(0, 0, np.arange(len(descriptors)))], 0
    while open_nodes:
        parent, level, members = open_nodes.pop()
        centres, nearest = _split(descriptors[members], generator)
        for branch, centre in enumerate(centres):
            number += 1
            below = members[nearest == branch]
            is_word = level + 1 == LEVELS or (level + 1 >= _GROUPED and len(below) <= BRANCHES)
            yield parent, centre, below if is_word else None
            if not is_word:
                open_nodes.append((number, level + 1, below))


def _split(descriptors: np.ndarray, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Centres (K, 32) of at most ten clusters of descriptors (N, 32), none of them empty, and the cluster of each."""
    centres = descriptors[generator.choice(len(descriptors), min(BRANCHES, len(descriptors)), replace=False)]
    nearest = np.full(len(descriptors), -1)
    for _ in range(_ROUNDS):
        bits = np.bitwise_count(descriptors.view(np.uint64)[:, None] ^ centres.view(np.uint64)).sum(axis=2)
        last, (_, nearest) = nearest, np.unique(bits.argmin(axis=1), return_inverse=True)
        if np.array_equal(last, nearest):
            break
        clusters = [np.unpackbits(descriptors[nearest == each], axis=1) for each in range(nearest.max() + 1)]
        centres = np.stack([np.packbits(2 * cluster.sum(axis=0, dtype=int) >= len(cluster)) for cluster in clusters])
    return centres[: nearest.max() + 1], nearest


def _render(folder: Path) -> Iterator[np.ndarray]:
    """Left images of the renders; what is there is used again."""
    from sigmaslam_benchmarks.trial import render
    from sigmaslam_synthetic.render_sequence import default_workers
    from sigmaslam_synthetic.simulation import Recipe

    for preset in _PRESETS:
        for seed in _SEEDS:
            for frame in open_sequence(render(folder, Recipe(preset, _FRAMES, seed), default_workers())).frames():
                yield frame.left


def main() -> None:
    """Writes a vocabulary."""
    parser = argparse.ArgumentParser(
        prog="python -m sigmaslam_benchmarks.tracking.orb_vocabulary",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("out", type=Path, help="text file to write")
    parser.add_argument("--runs", type=Path, required=True, help="folder for renders; what is there is used again")
    options = parser.parse_args()
    atomic_write_text(options.out, train_vocabulary(list(_render(options.runs))))


if __name__ == "__main__":
    main()
