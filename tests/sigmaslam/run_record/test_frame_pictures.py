"""Pictures of frames: which are kept, and what they show."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.run_record.frame_pictures import MAX_PICTURES, WORST, PictureRecorder, read_pictures
from tests.support.recorded_runs import some_estimate, some_frame

DOF = 200


def record(path: Path, nis: np.ndarray, length: int | None, status: list[str] | None = None):
    """The pictures of a run; frames that are lost have no degrees of freedom."""
    generator, recorder = np.random.default_rng(0), PictureRecorder(length)
    for k, value in enumerate(nis):
        lost = status is not None and status[k] == "lost"
        estimate = some_estimate(float(k), "lost" if lost else "tracking", 0.0 if lost else value, 0 if lost else DOF)
        recorder.add(estimate, some_frame(generator, 0 if lost else 8))
    recorder.write(path / "pictures.npz")
    return read_pictures(path / "pictures.npz")


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("count", [1, 60, 150, 1000])
def test_the_number_of_pictures_is_bounded_and_they_are_spread_evenly(tmp_path: Path, count: int, known: bool):
    pictures = record(tmp_path, np.full(count, float(DOF)), count if known else None)
    assert pictures.worst.sum() == min(WORST, count)
    even = pictures.timestamp[~pictures.worst]
    assert len(even) <= MAX_PICTURES * (1 if known else 2) + 1
    if count > 200:
        steps = np.diff(even)
        assert steps.min() == steps.max()
        assert count - even[-1] <= steps[0]


def test_the_worst_frames_are_those_of_the_largest_nis(tmp_path: Path):
    nis = np.random.default_rng(1).permutation(np.linspace(150, 400, 500))
    pictures = record(tmp_path, nis, 500)
    assert set(pictures.timestamp[pictures.worst]) == set(np.argsort(nis)[-WORST:].astype(float))


def test_the_score_of_a_consistent_filter_is_a_standard_normal_variable(tmp_path: Path):
    nis = np.random.default_rng(2).chisquare(DOF, 60)
    score = record(tmp_path, nis, 60).score
    assert abs(score.mean()) < 3 / np.sqrt(60)
    assert 0.7 < score.std() < 1.3


def test_each_loss_is_one_of_the_worst_with_both_eyes(tmp_path: Path):
    status = ["lost" if k in (70, 71, 72, 200) else "tracking" for k in range(300)]
    pictures = record(tmp_path, np.full(300, 300.0), 300, status)
    losses = pictures.timestamp[pictures.worst & np.isinf(pictures.score)]
    assert losses.tolist() == [70.0, 200.0]
    for k, timestamp in enumerate(pictures.timestamp):
        left, right = (cv2.imdecode(np.frombuffer(each, np.uint8), 0) if each else None for each in pictures.jpegs(k))
        assert left.shape == (60, 100)
        assert (right is not None) == (status[int(timestamp)] == "lost")


def test_trails_lead_to_where_the_landmark_was_in_the_frames_before(tmp_path: Path):
    generator, recorder = np.random.default_rng(0), PictureRecorder(3)
    frames = [some_frame(generator, 8, first) for first in (0, 2, 4)]
    for k, frame in enumerate(frames):
        recorder.add(some_estimate(float(k), "tracking", DOF, DOF), frame)
    recorder.write(tmp_path / "pictures.npz")
    pictures = read_pictures(tmp_path / "pictures.npz")
    last = pictures.matches(2)
    np.testing.assert_allclose(pictures.pixels[last], frames[2].pixels, rtol=1e-6)
    # Landmarks 4 to 11: of the frame before 4 to 9, of the one before that 4 to 7.
    np.testing.assert_allclose(pictures.trail[last][:6, 0], frames[1].pixels[2:], rtol=1e-6)
    np.testing.assert_allclose(pictures.trail[last][:4, 1], frames[0].pixels[4:], rtol=1e-6)
    assert np.isnan(pictures.trail[last][6:, 0]).all()
    assert np.isnan(pictures.trail[last][4:, 1]).all()


def test_another_file_is_refused(tmp_path: Path):
    np.savez(tmp_path / "pictures.npz", left=np.zeros(3))
    with pytest.raises(InputError, match=r"pictures\.npz: misses timestamp"):
        read_pictures(tmp_path / "pictures.npz")
