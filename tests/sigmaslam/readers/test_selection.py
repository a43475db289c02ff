"""Parts of recordings, and smaller images."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.readers import open_sequence
from sigmaslam.readers.selection import Selection
from tests.support.injected_faults import sequence_of


@pytest.mark.parametrize("source", ["files", "a source in order"])
@pytest.mark.parametrize(
    ("selection", "expected"),
    [
        (Selection(start=37), [37, 38, 39]),
        (Selection(start=3, count=2), [3, 4]),
        (Selection(start=1, count=4, every=5), [1, 6, 11, 16]),
        (Selection(every=20), [0, 20]),
        (Selection(count=1), [0]),
    ],
)
def test_a_selection_has_the_frames_it_names(
    demo_sequence: Path, source: str, selection: Selection, expected: list[int]
):
    sequence = open_sequence(demo_sequence)
    whole = list(sequence.frames())
    if source != "files":
        sequence = sequence_of(whole, sequence.camera)
    part = sequence.select(selection)
    assert part.length in (len(expected), None)
    frames = list(part.frames())
    assert [frame.index for frame in frames] == list(range(len(expected)))
    assert [frame.timestamp for frame in frames] == [whole[k].timestamp for k in expected]
    for frame, k in zip(frames, expected, strict=True):
        np.testing.assert_array_equal(frame.left, whole[k].left)
    # The whole is as it was, and can be sampled in part.
    assert len(list(sequence.frames())) == 40
    assert part.sample(1)[0][0].timestamp == whole[expected[0]].timestamp


@pytest.mark.parametrize("source", ["files", "a source in order"])
def test_of_image_files_only_those_at_the_times_are_read(demo_sequence: Path, source: str):
    sequence = open_sequence(demo_sequence)
    whole = list(sequence.frames())
    if source != "files":
        sequence = sequence_of(whole, sequence.camera)
    some = sequence.at(np.array([whole[k].timestamp - 1e-4 for k in (2, 7, 7, 39)]))
    expected = [2, 7, 39] if source == "files" else list(range(40))
    frames = list(some.frames())
    assert [frame.timestamp for frame in frames] == [whole[k].timestamp for k in expected]
    np.testing.assert_array_equal(frames[1].right, whole[expected[1]].right)
    assert len(list(sequence.frames())) == 40
    # After the last pair there is none: all are read, and it is the reader's to say so.
    assert len(list(sequence.at(np.array([whole[-1].timestamp + 1.0])).frames())) == 40


def test_a_selection_of_nothing_is_refused(demo_sequence: Path):
    with pytest.raises(InputError, match="has 40 pairs, none from 40 on"):
        open_sequence(demo_sequence).select(Selection(start=40))


def test_images_too_small_to_track_are_refused(demo_sequence: Path):
    sequence = open_sequence(demo_sequence)
    scale = 20 / min(sequence.camera.left.width, sequence.camera.left.height)
    with pytest.raises(InputError, match=r"--scale .* leaves \d+x20 pixels, too few to track: give at least"):
        sequence.select(Selection(), scale)


@pytest.mark.parametrize("scale", [0.5, 0.37])
def test_smaller_images_show_things_where_the_smaller_camera_sees_them(demo_sequence: Path, scale: float):
    sequence = open_sequence(demo_sequence)
    small = sequence.select(Selection(count=1), scale)
    frame, stored, camera = next(small.frames()), sequence.camera.left, small.camera.left
    assert (
        frame.left.shape == (camera.height, camera.width) == (round(scale * stored.height), round(scale * stored.width))
    )
    assert small.camera.baseline == sequence.camera.baseline
    # A direction is seen at the same share of the image's width and height, from the corner of the first pixel on.
    direction = np.array([0.2, -0.1, 1.0])
    share, small_share = (
        (model.matrix[:2] @ direction + 0.5) / (model.width, model.height) for model in (stored, camera)
    )
    np.testing.assert_allclose(small_share, share, atol=1e-12)
    # And the image is the stored one: enlarged again it is alike where it lies, and less so a pixel aside.
    whole = next(sequence.frames()).left.astype(float)
    again = cv2.resize(frame.left, (stored.width, stored.height), interpolation=cv2.INTER_LINEAR).astype(float)

    def difference(shift: int) -> float:
        return float(np.abs(np.roll(again, shift, axis=1) - whole)[:, 8:-8].mean())

    assert difference(0) < min(difference(1), difference(-1))
