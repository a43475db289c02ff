"""Recordings cut into steps: controls integrated, sightings in their place, delays, batches."""

import numpy as np
import pytest

from sigmaslam_localisation.recording import PlanarTruth, Recording
from sigmaslam_localisation.steps import LONGEST_STEP, make_steps

LANDMARKS = np.array([[1.0, 0.0], [0.0, 2.0]])


def recording(seconds=(0.35, 0.35, 0.9), landmark=(0, 1, 0), **changed):
    columns = {
        "name": "robot",
        "control_seconds": np.array([0.0, 0.5, 1.0]),
        "controls": np.array([[1.0, 0.0], [0.0, 2.0], [0.0, 0.0]]),
        "seconds": np.array(seconds),
        "landmark": np.array(landmark, int),
        "sightings": np.arange(2.0 * len(seconds)).reshape(-1, 2),
        "kind": "range-bearing",
        "landmarks": LANDMARKS,
    }
    return Recording(**{**columns, **changed})


@pytest.mark.parametrize("delay", [0.0, 0.125])
def test_all_that_the_controls_say_is_in_the_steps(delay):
    """Half a second of 1 m/s and half a second of 2 rad/s, of which a delay moves the last beyond the end."""
    steps = make_steps([recording()], [delay])
    np.testing.assert_allclose(steps.path.sum(axis=(0, 1)), [0.5, 1.0 - 2 * delay], atol=1e-12)
    before = steps.seconds[1:, 0] <= delay + 1e-12
    assert not steps.path[before].any()
    assert steps.duration.max() <= LONGEST_STEP + 1e-12
    np.testing.assert_allclose(np.diff(steps.seconds, axis=0), steps.duration)


def test_sightings_stand_at_the_end_of_their_step():
    steps = make_steps([recording()], [0.0])
    step, robot, slot = np.nonzero(np.isfinite(steps.value[..., 0]))
    np.testing.assert_allclose(steps.seconds[step + 1, robot], [0.35, 0.35, 0.9])
    assert slot.tolist() == [0, 1, 0]
    assert steps.landmark[step, robot, slot].tolist() == [0, 1, 0]
    np.testing.assert_array_equal(steps.position[step, robot, slot], LANDMARKS[[0, 1, 0]])
    np.testing.assert_array_equal(steps.value[step, robot, slot], np.arange(6.0).reshape(3, 2))
    np.testing.assert_allclose(steps.since[step, robot, slot], [np.inf, np.inf, 0.55])


def test_a_delay_beside_odometry_is_that_of_the_sightings():
    """Motions keep their times, and what was stamped 0.125 s late stands where it was seen."""
    late, in_time = make_steps([recording(odometry=True)], [0.125]), make_steps([recording()], [0.0])
    step, robot, slot = np.nonzero(np.isfinite(late.value[..., 0]))
    np.testing.assert_allclose(late.seconds[step + 1, robot], [0.225, 0.225, 0.775])
    np.testing.assert_allclose(late.since[step, robot, slot], [np.inf, np.inf, 0.55])
    np.testing.assert_allclose(late.path.sum(axis=(0, 1)), in_time.path.sum(axis=(0, 1)))


def test_what_is_seen_at_the_start_is_not_lost():
    steps = make_steps([recording(seconds=(0.0, 0.9), landmark=(0, 1))], [0.0])
    assert np.isfinite(steps.value[..., 0]).sum() == 2
    assert steps.duration[0, 0] == 0
    assert np.isfinite(steps.value[0, 0, 0]).all()


def test_a_batch_holds_what_its_robots_hold_alone():
    robots = [recording(), recording(seconds=(0.1, 0.2, 0.3, 0.3), landmark=(0, 1, 0, 1))]
    both = make_steps(robots, [0.0, 0.1])
    for b, (robot, delay) in enumerate(zip(robots, [0.0, 0.1], strict=True)):
        alone = make_steps([robot], [delay])
        K, L = alone.value.shape[0], alone.value.shape[2]
        assert both.count[b] == K
        for name in ("duration", "path"):
            np.testing.assert_array_equal(getattr(both, name)[:K, b], getattr(alone, name)[:, 0])
            assert not getattr(both, name)[K:, b].any()
        np.testing.assert_array_equal(both.value[:K, b, :L], alone.value[:, 0])
        assert np.isnan(both.value[K:, b]).all()
        assert np.isnan(both.value[:, b, L:]).all()


def test_nothing_is_interpolated_in_gaps_of_the_truth():
    truth = PlanarTruth(np.array([0.0, 0.1, 0.5]), np.array([[0.0, 0, 0], [1, 0, 0.5], [2, 0, 0.5]]), longest_gap=0.2)
    poses = truth.at(np.array([-0.1, 0.0, 0.05, 0.3, 0.5, 0.6]))
    assert np.isnan(poses[:, 0]).tolist() == [True, False, False, True, False, True]
    np.testing.assert_allclose(poses[2], [0.5, 0.0, 0.25])


def test_within_keeps_near_landmarks_alone():
    near = recording().within(2.5)
    assert near.sightings[:, 0].tolist() == [0.0, 2.0]
    assert near.landmark.tolist() == [0, 1]
