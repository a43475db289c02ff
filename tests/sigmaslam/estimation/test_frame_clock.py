"""The clock of frames against stamps whose noise is known."""

from __future__ import annotations

import numpy as np
import pytest

from sigmaslam.estimation.frame_clock import FrameClock, missing_frames, stamp_noise

FRAMES = 40
REGULAR = 0.1 * np.arange(FRAMES)


def steps_of(stamps: np.ndarray) -> list[tuple[float, float]]:
    clock = FrameClock()
    return [clock.tick(step)[:2] for step in np.diff(stamps)]


@pytest.mark.parametrize(
    "stamps",
    [
        REGULAR,
        REGULAR + np.random.default_rng(1).normal(0.0, 2e-3, FRAMES),
        np.delete(REGULAR, [5, 6, 15, 20, 21, 22]),
        np.cumsum(0.05 * np.random.default_rng(2).integers(1, 5, FRAMES)),
        REGULAR + 7.0 * (np.arange(FRAMES) > 20),
        np.cumsum(np.random.default_rng(3).uniform(1.0, 4.0, FRAMES)),
    ],
    ids=["exact", "a sensor's own noise", "drops", "chosen frames", "a pause", "keyframes"],
)
def test_stamps_that_can_be_believed_are_taken_to_the_bit(stamps: np.ndarray):
    assert steps_of(stamps) == [(step, 0.0) for step in np.diff(stamps)]


def test_the_noise_of_stamps_is_found():
    for seed in range(5):
        stamps = 0.1 * np.arange(2000) + np.random.default_rng(seed).normal(0.0, 0.02, 2000)
        assert stamp_noise(np.diff(stamps)) == pytest.approx(0.02, rel=0.1)


def test_intervals_that_vary_by_themselves_are_no_noise_of_stamps():
    """Neighbours do not depend on each other: the covariance is within three of its standard deviations of zero."""
    intervals = np.random.default_rng(0).uniform(0.08, 0.12, 5000)
    assert stamp_noise(intervals) == 0.0


@pytest.mark.parametrize(
    ("kept", "rate", "missing"),
    [
        (range(40), 20.0, 0),
        ([k for k in range(40) if k % 5], 20.0, 7),
        ([*range(15), *range(25, 40)], 20.0, 10),
        ([*range(15), *range(115, 140)], 20.0, 100),
        ([0, 1, 3, 4, 8], 1.0, 0),
    ],
    ids=["good", "drops", "gap", "clock set", "chosen"],
)
def test_frames_that_are_missing_are_counted(kept: list[int], rate: float, missing: int):
    assert missing_frames(np.diff(np.array(kept) / rate)) == missing


def test_another_rate_is_no_row_of_missing_frames():
    assert missing_frames(np.r_[np.full(60, 1 / 30), np.full(50, 1 / 15)]) <= 2
    assert missing_frames(np.r_[np.full(60, 1 / 30), 1.7e9, np.full(60, 1 / 30)]) == 599
    assert missing_frames(np.zeros(5)) == missing_frames(np.array([0.1, np.nan])) == missing_frames(np.zeros(0)) == 0


@pytest.mark.parametrize(
    "noise",
    [
        0.04 * (-1.0) ** np.arange(FRAMES),
        0.03 * (-1.0) ** np.arange(FRAMES),
        np.random.default_rng(4).normal(0.0, 0.02, FRAMES),
        -0.096 * (np.arange(FRAMES) % 3) + 0.096,
    ],
    ids=["alternating", "alternating by one to four", "Gaussian", "bursts of three"],
)
def test_jitter_is_smoothed_and_said(noise: np.ndarray):
    """From the second burst on the step is nearer to the camera's than the stamps', and three sigma hold the truth."""
    stamps = REGULAR + noise
    found = np.array(steps_of(stamps))[8:]
    assert (found[:, 1] > 0.0).mean() > 0.9
    assert np.abs(found[:, 0] - 0.1).mean() < 0.5 * np.abs(np.diff(stamps)[8:] - 0.1).mean()
    assert (np.abs(found[:, 0] - 0.1) < 3.0 * found[:, 1] + 1e-9).mean() > 0.9


@pytest.mark.parametrize("size", [3, 5])
def test_bursts_are_no_pauses_of_a_fast_camera(size: int):
    """After the first burst no stamp is believed, and one sigma holds the camera's own step."""
    stamps = 0.1 * size * (np.arange(FRAMES) // size + 1) + 0.004 * (np.arange(FRAMES) % size)
    found = np.array(steps_of(stamps))[size:]
    assert (found[:, 1] > 0.0).all()
    assert (np.abs(found[:, 0] - 0.1) < found[:, 1]).all()


@pytest.mark.parametrize("size", [2, 3, 5])
def test_frames_of_bursts_are_known_to_be_regular_once_some_were_seen(size: int):
    """A sigma of a whole interval leaves near landmarks unsearched."""
    stamps = 0.1 * size * (np.arange(FRAMES) // size + 1) + 0.004 * (np.arange(FRAMES) % size)
    found = np.array(steps_of(stamps))[2 * size + 10 :]
    assert (np.abs(found[:, 0] - 0.1) < found[:, 1]).all()
    assert (found[:, 1] < 0.05).all()


@pytest.mark.parametrize(
    ("second", "is_noise"), [(0.14, True), (0.09, True), (0.062, False), (0.12, False), (0.18, False)]
)
def test_two_intervals_that_differ_but_not_by_whole_frames_are_not_believed(second: float, is_noise: bool):
    """A velocity learned by the first one would be wrong by half."""
    clock = FrameClock()
    assert clock.tick(0.06) == (0.06, 0.0, 1.0)
    seconds, sigma, stretch = clock.tick(second)
    assert (sigma > 0.0) == is_noise
    if is_noise:
        assert abs(seconds - 0.5 * (0.06 + second)) < sigma
        assert stretch == pytest.approx(0.5 * (0.06 + second) / 0.06)


def test_what_was_learned_by_intervals_within_a_burst_is_made_good():
    clock = FrameClock()
    stretches = [clock.tick(step)[2] for step in [0.004, 0.004, 0.004, 0.006, 0.5, 0.004, 0.004]]
    assert stretches[4] == pytest.approx(0.1036 / 0.006, rel=0.1)
    assert stretches[:3] + stretches[5:] == [1.0] * 5


@pytest.mark.parametrize(
    ("intervals", "late"),
    [
        ([0.1] * 9 + [0.6], 0.5),
        ([0.1] * 3 + [0.6], 0.0),  # too few to tell what is usual
        ([0.1] * 9 + [0.2], 0.0),  # one frame is missing
        ([0.8] * 9 + [4.0], 0.0),  # so slow a camera's frames were chosen
        ([0.1] * 9 + [0.6, 0.1], 0.0),
        (([0.004] * 4 + [0.484]) * 2, 0.0),  # a burst ends as the one before
        ([0.08, 0.12] * 8 + [0.62], 0.5),  # a clock that jitters was set
    ],
)
def test_a_long_interval_may_be_a_clock_that_was_set(intervals: list[float], late: float):
    clock = FrameClock()
    for each in intervals:
        clock.tick(each)
    assert clock.late == pytest.approx(late)


def test_an_interval_unlike_the_one_before_is_known_even_where_stamps_are_believed():
    """Stamps that take turns by one to four look as if frames were missing."""
    clock = FrameClock()
    told = [(clock.tick(step)[1], clock.differs) for step in (0.04, 0.16, 0.16)]
    assert told == [(0.0, False), (0.0, True), (0.0, False)]


@pytest.mark.parametrize(("sensors", "seconds"), [((), 20.0), (("odometry",), 60.0)])
def test_a_pause_is_extrapolated_as_far_as_a_velocity_alone_allows(sensors: tuple[str, ...], seconds: float):
    """Wheels tell where they went in all of it: over a part of it they would be surely wrong."""
    clock = FrameClock(sensors)
    assert [clock.tick(step)[0] for step in (0.1, 60.0)] == [0.1, seconds]
