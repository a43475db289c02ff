"""Each fault of a driver is what its name says, and nothing else changes."""

import numpy as np
import pytest

from sigmaslam_benchmarks.live.driver_faults import (
    FAULTS,
    DrivenFrame,
    Frames,
    scale_light,
    shift_image,
    spoil,
    start_of,
    turn_image,
)

COUNT, INTERVAL = 30, 0.1
STAMPS = [*(name for name in FAULTS if name.startswith(("alternate", "jitter", "bursts"))),
          "one_late", "duplicates", "drift", "step_forward", "step_back"]  # fmt: skip


def good(count: int = COUNT) -> Frames:
    """Frames whose images tell their number below a hundred: grey value of the left one, 100 more of the right one."""
    shape = (24, 32)
    return [
        DrivenFrame(k, INTERVAL * k, np.full(shape, k % 100, np.uint8), np.full(shape, 100 + k % 100, np.uint8))
        for k in range(count)
    ]


def stamps(name: str, seed: int = 3) -> np.ndarray:
    return np.array([frame.timestamp for frame in spoil(name, good(), seed)])


def late(name: str) -> np.ndarray:
    """By how many intervals stamps are late."""
    return (stamps(name) - INTERVAL * np.arange(COUNT)) / INTERVAL


def shown(name: str) -> tuple[list[int], list[int]]:
    """Which left and which right image each delivered frame has."""
    frames = spoil(name, good(), 3)
    return [int(frame.left[0, 0]) for frame in frames], [int(frame.right[0, 0]) - 100 for frame in frames]


@pytest.mark.parametrize("name", FAULTS)
def test_good_frames_are_left_alone_and_a_seed_gives_the_same_frames(name: str):
    frames = good()
    first = spoil(name, frames, 3)
    again = spoil(name, good(), 3)
    for number, frame in enumerate(frames):
        assert frame.timestamp == INTERVAL * number
        assert (frame.left == number).all()
        assert (frame.right == 100 + number).all()
    assert [frame.timestamp for frame in first] == [frame.timestamp for frame in again]
    for one, other in zip(first, again, strict=True):
        assert np.array_equal(one.left, other.left)
        assert np.array_equal(one.right, other.right)


@pytest.mark.parametrize("name", STAMPS)
def test_faults_of_stamps_change_no_image_and_no_moment(name: str):
    assert shown(name) == (list(range(COUNT)), list(range(COUNT)))
    assert [frame.moment for frame in spoil(name, good(), 3)] == list(range(COUNT))


@pytest.mark.parametrize("name", [name for name in STAMPS if name not in ("duplicates", "step_back")])
def test_stamps_stay_in_order(name: str):
    assert (np.diff(stamps(name)) > 0).all()


def test_stamps_are_late_by_what_is_asked_for():
    assert late("alternate_40") == pytest.approx(0.4 * (-1.0) ** np.arange(COUNT))
    assert late("bursts_3")[:6] == pytest.approx([2.0, 1.04, 0.08, 2.0, 1.04, 0.08])
    assert np.diff(stamps("bursts_5"))[:5] / INTERVAL == pytest.approx([0.04, 0.04, 0.04, 0.04, 4.84])
    assert sorted(late("one_late"))[-2:] == pytest.approx([0.0, 0.7])
    assert late("drift")[-1] == pytest.approx(0.01 * (COUNT - 1), abs=0.1)
    assert late("step_forward") == pytest.approx(5.0 * (np.arange(COUNT) >= COUNT // 3))
    assert late("step_back") == pytest.approx(-5.0 * (np.arange(COUNT) >= COUNT // 3))
    assert (np.diff(stamps("duplicates")) == 0).sum() == 2


def test_jitter_has_the_spread_that_is_asked_for():
    frames = good(3000)
    delays = np.array([f.timestamp - g.timestamp for f, g in zip(spoil("jitter_20", frames, 3), frames, strict=True)])
    assert delays.std() == pytest.approx(0.2 * INTERVAL, rel=0.05)
    assert abs(delays).max() <= 0.4501 * INTERVAL


def test_frozen_images_are_those_before_and_return():
    for name, count in (("frozen_5", 5), ("frozen_10", 10)):
        expected = [9 if 10 <= k < 10 + count else k for k in range(COUNT)]
        assert shown(name) == (expected, expected)
        assert stamps(name) == pytest.approx(INTERVAL * np.arange(COUNT))
        assert [frame.moment for frame in spoil(name, good(), 3)] == list(range(COUNT))
    assert shown("frozen_right") == (list(range(COUNT)), [9 if 10 <= k < 15 else k for k in range(COUNT)])


def test_missing_frames_keep_the_moments_of_the_others():
    gap = spoil("gap_10", good(), 3)
    assert [frame.moment for frame in gap] == [*range(10), *range(20, 30)]
    dropped = [frame.moment for frame in spoil("drop_20", good(1000), 3)]
    assert dropped[0] == 0
    assert len(dropped) == pytest.approx(800, abs=40)
    for frame in gap:
        assert frame.timestamp == pytest.approx(INTERVAL * frame.moment)
        assert frame.left[0, 0] == frame.moment


def test_images_come_in_the_wrong_order():
    old = [k - 3 if k % 10 == 5 else k for k in range(COUNT)]
    assert shown("repeated") == (old, old)
    left, right = shown("out_of_order")
    assert left == right
    assert left[4:8] == [4, 6, 5, 7]
    assert sorted(left) == list(range(COUNT))
    assert shown("right_lags") == (list(range(COUNT)), [0, *range(COUNT - 1)])
    torn = spoil("torn", good(), 3)[5]
    assert (torn.left[:12] == 5).all()
    assert (torn.left[12:] == 4).all()
    assert (torn.right[12:] == 104).all()


def test_light_changes_from_half_time_on():
    frames = spoil("right_dark", good(), 3)
    assert [int(frame.right[0, 0]) for frame in frames[13:17]] == [113, 114, round(115 / 3), round(116 / 3)]
    assert shown("right_dark")[0] == list(range(COUNT))
    bright = spoil("exposure", good(), 3)
    assert (bright[14].left[0, 0], bright[16].left[0, 0], bright[16].right[0, 0]) == (14, 40, 255)
    hunting = spoil("gain", good(), 3)
    assert [int(frame.right[0, 0]) for frame in hunting[:15]] == list(range(100, 115))
    assert len({round(float(frame.right[0, 0]) / (100 + frame.moment), 2) for frame in hunting[15:]}) > 10
    assert scale_light(np.array([[0, 100, 200]], np.uint8), 1.5).tolist() == [[0, 150, 255]]


def test_a_cover_is_dark_for_its_time():
    means = [frame.left.mean() for frame in spoil("covered_1", good(), 3)]
    assert [k for k, mean in enumerate(means) if abs(mean - k) > 1e-9] == list(range(10, 20))
    assert max(means[10:20]) < 10
    assert FAULTS["covered_1"].fits(good())
    assert not FAULTS["covered_3"].fits(good())
    assert start_of(good()) == 10


def test_eyes_are_swapped_from_half_time_on():
    left, right = shown("swapped")
    assert left[14:16] == [14, 115]
    assert right[14:16] == [14, -85]


def test_a_bump_moves_the_right_image():
    image = np.random.default_rng(0).integers(0, 255, (40, 60), np.uint8)
    assert np.array_equal(shift_image(image, 3, 0)[3:], image[:-3])
    assert np.array_equal(shift_image(image, 0, 2)[:, 2:], image[:, :-2])
    frames = [DrivenFrame(k, INTERVAL * k, image, image) for k in range(10)]
    for name in ("rows_3", "columns_2", "yaw"):
        bumped = spoil(name, frames, 0)
        assert all(np.array_equal(frame.left, image) for frame in bumped)
        assert [np.array_equal(frame.right, image) for frame in bumped] == [True] * 5 + [False] * 5
    assert np.array_equal(spoil("rows_3", frames, 0)[7].right, shift_image(image, 3, 0))


def test_a_turn_to_the_right_moves_what_is_seen_to_the_left():
    image = np.zeros((101, 201), np.uint8)
    image[48:53, 98:103] = 200
    turned = turn_image(image, 2.0).astype(float)
    columns = (turned.sum(axis=0) * np.arange(201)).sum() / turned.sum()
    rows = (turned.sum(axis=1) * np.arange(101)).sum() / turned.sum()
    assert columns == pytest.approx(100 - 201 * np.tan(np.deg2rad(2.0)), abs=0.1)
    assert rows == pytest.approx(50, abs=0.1)
