"""The first frames of the shipped sequence, as they are or spoilt."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

Pair = tuple[np.ndarray, np.ndarray]


def copy_frames(
    demo: Path,
    folder: Path,
    count: int,
    change: Callable[[int, np.ndarray, np.ndarray], Pair] | None = None,
    slower: float = 1.0,
) -> Path:
    """Copies frames into a folder of the same layout.

    Args:
        demo: folder of the sequence.
        folder: to make.
        count: of frames.
        change: makes another pair of images of a frame's number and its pair.
        slower: factor on the time between frames.
    """
    for name in ("image_0", "image_1"):
        (folder / name).mkdir(parents=True)
    for k, image in enumerate(sorted((demo / "image_0").iterdir())[:count]):
        paths = [demo / name / image.name for name in ("image_0", "image_1")]
        if change is None:
            for path in paths:
                shutil.copy(path, folder / path.parent.name)
            continue
        pair = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths]
        assert pair[0] is not None
        assert pair[1] is not None
        for path, changed in zip(paths, change(k, pair[0], pair[1]), strict=True):
            cv2.imwrite(str(folder / path.parent.name / image.name), changed)
    shutil.copy(demo / "calib.txt", folder)
    (folder / "poses.txt").write_text("".join((demo / "poses.txt").read_text().splitlines(keepends=True)[:count]))
    np.savetxt(folder / "times.txt", slower * np.loadtxt(demo / "times.txt")[:count], "%.9f")
    return folder
