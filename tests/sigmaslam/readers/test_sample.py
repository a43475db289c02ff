"""Frames that a sequence is judged by."""

import shutil
from pathlib import Path

import numpy as np

from sigmaslam.readers import open_sequence
from tests.support.injected_faults import sequence_of


def indices(steps):
    return [(frame.index, None if after is None else after.index) for frame, after in steps]


def test_a_sample_of_files_is_spread_over_the_recording(demo_sequence: Path):
    sequence = open_sequence(demo_sequence)
    frames = list(sequence.frames())
    steps = sequence.sample(3)
    last = len(frames) - 2
    assert indices(steps) == [(0, 1), (last // 2, last // 2 + 1), (last, last + 1)]
    for frame, after in steps:
        np.testing.assert_array_equal(frame.right, frames[frame.index].right)
        assert after.timestamp == frames[after.index].timestamp


def test_a_sample_leaves_out_what_cannot_be_read(demo_sequence: Path, tmp_path: Path):
    folder = shutil.copytree(demo_sequence, tmp_path / "sequence")
    images = sorted((folder / "image_1").iterdir())
    images[1].write_bytes(b"")
    images[-2].write_bytes(b"")
    steps = open_sequence(folder).sample(2)
    assert indices(steps) == [(0, None)]


def test_a_sequence_in_order_is_sampled_at_its_start(demo_sequence: Path):
    source = open_sequence(demo_sequence)
    frames = list(source.frames())
    assert indices(sequence_of(frames, source.camera).sample(3)) == [(0, 1), (5, 6), (10, 11)]
    assert indices(sequence_of(frames[:6], source.camera).sample(3)) == [(0, 1), (5, None)]
    assert indices(sequence_of(frames[:1], source.camera).sample(3)) == [(0, None)]
    assert len(open_sequence(demo_sequence).sample(1)) == 1
