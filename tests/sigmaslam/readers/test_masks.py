"""Masks of left images: one for all frames or one a frame; each that cannot be used is named, with what to do."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.readers import StereoSequence, open_sequence
from sigmaslam.readers.masks import read_mask
from sigmaslam.readers.selection import Selection
from tests.support.videos import write_video

WIDTH, HEIGHT, COUNT = 64, 48, 4
CALIBRATION = "".join(f"P{eye}: 50 0 32 {-5 * eye} 0 50 24 0 0 0 1 0\n" for eye in range(2))


def write_masks(folder: Path, ending: str = ".png") -> Path:
    """One mask a frame: the first k rows of frame k and its first row are zero, the others 1."""
    folder.mkdir()
    for k in range(COUNT):
        mask = np.ones((HEIGHT, WIDTH), np.uint8)
        mask[: k + 1] = 0
        cv2.imwrite(str(folder / f"{k:06d}{ending}"), mask)
    return folder


@pytest.fixture
def sequence(tmp_path: Path) -> StereoSequence:
    folder = tmp_path / "recording"
    rng = np.random.default_rng(0)
    for eye in range(2):
        (folder / f"image_{eye}").mkdir(parents=True)
        for k in range(COUNT):
            image = rng.integers(0, 255, (HEIGHT, WIDTH), np.uint8)
            cv2.imwrite(str(folder / f"image_{eye}" / f"{k:06d}.png"), image)
    (folder / "calib.txt").write_text(CALIBRATION)
    (folder / "times.txt").write_text("".join(f"{0.1 * k}\n" for k in range(COUNT)))
    return open_sequence(folder)


def zero_rows(sequence: StereoSequence) -> list[int]:
    """Of each frame's mask; whole rows are zero, or none of their pixels."""
    masks = [frame.mask for frame in sequence.frames()]
    assert all((mask.any(axis=1) == mask.all(axis=1)).all() for mask in masks)
    return [int((~mask.any(axis=1)).sum()) for mask in masks]


@pytest.mark.parametrize("ending", [".png", ".png.png"])
def test_each_frame_has_the_mask_of_its_name(sequence: StereoSequence, tmp_path: Path, ending: str):
    assert [frame.mask for frame in sequence.frames()] == [None] * COUNT
    masks = write_masks(tmp_path / "masks", ending)
    sequence.use_masks(masks)
    assert zero_rows(sequence) == [1, 2, 3, 4]
    part = sequence.select(Selection(1, 2))
    part.use_masks(masks)
    assert zero_rows(part) == [2, 3]


def test_one_mask_is_for_all_frames_and_shrinks_with_them(sequence: StereoSequence, tmp_path: Path):
    mask = write_masks(tmp_path / "masks") / "000003.png"
    sequence.use_masks(mask)
    assert zero_rows(sequence) == [4] * COUNT
    half = sequence.select(Selection(), 0.75)
    half.use_masks(mask)
    assert zero_rows(half) == [3] * COUNT


def test_a_video_takes_one_mask_and_no_folder(tmp_path: Path):
    pair = np.random.default_rng(0).integers(0, 255, (HEIGHT, 2 * WIDTH), np.uint8)
    write_video(tmp_path / "film.mp4", [pair] * COUNT, 10.0)
    (tmp_path / "calib.txt").write_text(CALIBRATION)
    film = open_sequence(tmp_path / "film.mp4", calibration=tmp_path / "calib.txt")
    masks = write_masks(tmp_path / "masks")
    film.use_masks(masks / "000001.png")
    assert zero_rows(film) == [2] * COUNT
    with pytest.raises(InputError, match="goes with image files; give one mask for all frames"):
        film.use_masks(masks)


def test_masks_that_cannot_be_used_are_refused(sequence: StereoSequence, tmp_path: Path):
    masks = write_masks(tmp_path / "masks")
    (tmp_path / "text.png").write_text("no image")
    cv2.imwrite(str(tmp_path / "small.png"), np.ones((HEIGHT // 2, WIDTH // 2), np.uint8))
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    for name, words in {
        "missing.png": r"missing\.png.*no such file",
        "text.png": r"text\.png: not an image.*give the mask as a PNG",
        "small.png": r"small\.png: the mask is 32x24 pixels, the left image 64x48",
        "black.png": r"black\.png: the mask is zero everywhere",
    }.items():
        with pytest.raises(InputError, match=words):
            sequence.use_masks(tmp_path / name)
    (masks / "000002.png").unlink()
    with pytest.raises(InputError, match=r"masks: 1 of 4 frames have no mask, the first is 000002\.png"):
        sequence.use_masks(masks)
    cv2.imwrite(str(masks / "000002.png"), np.ones((HEIGHT, WIDTH), np.uint8))
    cv2.imwrite(str(masks / "000000.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(InputError, match=r"000000\.png: the mask is zero everywhere"):
        sequence.use_masks(masks)


def test_a_later_mask_that_cannot_be_used_skips_its_frame(sequence: StereoSequence, tmp_path: Path):
    masks = write_masks(tmp_path / "masks")
    (masks / "000002.png").write_text("no image")
    sequence.use_masks(masks)
    assert zero_rows(sequence) == [1, 2, 4]
    [skipped] = sequence.skipped
    assert skipped.index == 2
    assert "000002.png: not an image" in skipped.reason


def test_transparency_masks_nothing(tmp_path: Path):
    mask = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    mask[..., 3] = 255
    mask[:10, :, 1] = 1
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    assert read_mask(tmp_path / "mask.png", WIDTH, HEIGHT).sum() == 10 * WIDTH
