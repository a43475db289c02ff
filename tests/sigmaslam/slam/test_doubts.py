"""Faults of drivers in the demo: poses are right, or there is a doubt."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from sigmaslam.estimation.chi_square import CHI_SQUARE_999
from sigmaslam.geometry.se3 import se3_inverse, se3_log
from sigmaslam.slam import scrutiny
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.doubt import Doubt, Doubts
from sigmaslam.slam.frame import Frame
from sigmaslam.slam.guided_matching import GuidedMatches
from sigmaslam.slam.localisation import Prediction
from sigmaslam.slam.mapping import KeyframeTracks, Mapper
from sigmaslam.slam.rig_change import RigChange, find_change
from sigmaslam.slam.stopwatch import Stopwatch
from sigmaslam.slam.tracker import Estimate, StereoTracker
from sigmaslam_benchmarks.live.driver_faults import DrivenFrame, shift_image, spoil
from tests.support.estimates import Demo, squared_error, track

FRAMES = 40

pytestmark = pytest.mark.long


def driven(demo: Demo, fault: str, noise: float = 0.0) -> tuple[list[Estimate], np.ndarray]:
    """The estimates with a fault, then noise of this sigma, and the true pose at the stamp of each frame."""
    camera, frames, truth = demo
    good = [DrivenFrame(k, each.timestamp, each.left, each.right) for k, each in enumerate(frames[:FRAMES])]
    spoiled, tracker = spoil(fault, good, 7), StereoTracker(camera)
    if noise:
        rng = np.random.default_rng(7)
        spoiled = [
            replace(each, left=noisy(each.left, noise, rng), right=noisy(each.right, noise, rng)) for each in spoiled
        ]
    estimates = [tracker.step(each.left, each.right, each.timestamp) for each in spoiled]
    return estimates, se3_inverse(truth[0]) @ truth[[each.moment for each in spoiled]]


def noisy(image: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    return np.clip(np.rint(image + rng.normal(0.0, sigma, image.shape)), 0, 255).astype(np.uint8)


def silent_wrong(estimates: list[Estimate], truth: np.ndarray) -> list[int]:
    pairs = enumerate(zip(estimates, truth, strict=True))
    return [
        k for k, (each, true) in pairs if each.status == "tracking" and squared_error(each, true) > CHI_SQUARE_999[6]
    ]


@pytest.mark.parametrize(
    ("fault", "doubt"),
    [
        ("out_of_order", Doubt.TIME),
        ("uncounted", Doubt.TIME),
        ("frozen_anew", Doubt.TIME),
        ("columns_2", Doubt.RIG),
        ("rows_3", Doubt.RIG),
        ("yaw", Doubt.RIG),
    ],
)
def test_a_fault_is_doubted_and_no_pose_is_silently_wrong(demo: Demo, fault: str, doubt: Doubt):
    estimates, truth = driven(demo, fault)
    assert silent_wrong(estimates, truth) == []
    assert any(doubt in each.doubts for each in estimates)
    assert sum(each.status == "tracking" for each in estimates) > FRAMES // 2


def test_images_delivered_again_are_doubtful_until_the_camera_moves(demo: Demo):
    estimates, truth = driven(demo, "frozen_anew")
    first = FRAMES // 3
    frozen = range(first, first + 10)
    assert all(Doubt.TIME in estimates[k].doubts for k in frozen)
    assert max(squared_error(estimates[k], truth[k]) for k in frozen) < 2.0 * CHI_SQUARE_999[6]
    assert all(each.status == "tracking" and not each.doubts for each in estimates[first + 13 :])


def test_a_stop_before_a_covered_lens_is_one(demo: Demo):
    """Black images say nothing of it: the camera stays where it stood, and is found there."""
    camera, frames, _ = demo
    rng, step, stop = np.random.default_rng(3), frames[1].timestamp - frames[0].timestamp, frames[12]
    tracker, found = StereoTracker(camera), []
    for k in range(28):
        shown = frames[k] if k < 12 else stop
        left, right = (noisy(each, 2.0, rng) if k >= 12 else each for each in (shown.left, shown.right))
        if 18 <= k < 22:
            left, right = noisy(0 * left, 1.5, rng), noisy(0 * right, 1.5, rng)
        found.append(tracker.step(left, right, frames[0].timestamp + k * step))
    assert Doubt.TIME in found[16].doubts
    assert {each.status for each in found[18:22]} == {"lost"}
    places = np.array([each.T_world_camera[:3, 3] for each in found])
    assert np.linalg.norm(places[18:] - places[17], axis=1).max() < 0.03
    assert all(each.status in ("tracking", "doubtful", "relocalised") for each in found[22:])


def test_the_covariance_of_an_image_of_another_time_holds_the_pose_at_its_stamp(demo: Demo):
    """Velocity and stamp tell where the camera was; the image alone was up to 170 squared sigmas off in a room."""
    estimates, truth = driven(demo, "out_of_order")
    doubted = [k for k, each in enumerate(estimates) if Doubt.TIME in each.doubts]
    assert {5, 6, 15, 16} <= set(doubted)
    assert max(squared_error(estimates[k], truth[k]) for k in doubted) < CHI_SQUARE_999[6]


@pytest.mark.parametrize("fault", ["none", "jitter_20", "alternate_20", "alternate_40", "bursts_3"])
def test_stamps_that_can_be_read_leave_poses_right(demo: Demo, fault: str):
    estimates, truth = driven(demo, fault)
    assert silent_wrong(estimates, truth) == []
    assert sum(each.status == "tracking" for each in estimates) >= FRAMES - 4
    assert fault != "none" or not any(each.doubts for each in estimates)


def test_a_velocity_that_was_learned_within_a_burst_is_unlearned(demo: Demo):
    """Stamps that vary by a little within the first burst are no reason to believe the others."""
    camera, frames, truth = demo
    good = [DrivenFrame(k, each.timestamp, each.left, each.right) for k, each in enumerate(frames[:12])]
    tracker = StereoTracker(camera)
    for k, each in enumerate(spoil("bursts_5", good, 7)):
        tracker.step(each.left, each.right, each.timestamp + 0.001 * (k % 5 == 4))
    speeds = np.linalg.norm(np.diff(truth[:12, :3, 3], axis=0), axis=1) / (frames[1].timestamp - frames[0].timestamp)
    assert np.linalg.norm(tracker._motion.twist[:3]) < 1.5 * speeds.max()


@pytest.mark.parametrize("fault", ["repeated", "torn"])
def test_an_old_pair_is_skipped_and_so_is_one_that_is_old_in_part(demo: Demo, fault: str):
    estimates, truth = driven(demo, fault)
    assert [k for k, each in enumerate(estimates) if each.status == "skipped"] == list(range(5, FRAMES, 10))
    assert silent_wrong(estimates, truth) == []


def test_a_torn_image_whose_rows_are_no_copies_is_doubted(demo: Demo):
    """As after a lossy codec, where no row equals one of the image before."""
    estimates, truth = driven(demo, "torn", noise=1.0)
    torn = range(5, FRAMES, 10)
    assert all({Doubt.TIME, Doubt.MOTIONS} & set(estimates[k].doubts) for k in torn)
    assert not any(estimates[k].status == "tracking" for k in torn)
    assert silent_wrong(estimates, truth) == []
    assert sum(each.status == "tracking" for each in estimates) > FRAMES // 2


@pytest.mark.parametrize("is_exchanged", [True, False], ids=["exchanged", "right eye covered"])
def test_exchanged_eyes_whose_rows_do_not_fit_are_told_from_a_dead_eye(demo: Demo, is_exchanged: bool):
    """As after the rectification of each by the other's, where too few places behind infinity are found to judge."""
    camera, frames, _ = demo
    tracker = StereoTracker(camera)
    track(tracker, frames[:3])
    left, right = frames[3].left, frames[3].right
    given = (np.roll(right, 6, axis=0), left) if is_exchanged else (left, np.zeros_like(right))
    frame = Frame(*given, tracker._frontend, exchanged=lambda: (left, right) if is_exchanged else given[::-1])
    last = tracker._keyframes.active[-1].view
    usual = int(np.isfinite(last.disparity).sum())
    assert not frame.view.has_stereo(usual // 10, usual)
    assert frame.is_exchanged(last, usual // 2) is is_exchanged


def test_exchanged_eyes_are_named_and_give_no_pose(demo: Demo):
    estimates, _ = driven(demo, "swapped")
    assert all(each.status == "lost" and list(each.doubts) == [Doubt.EYES] for each in estimates[FRAMES // 2 :])


def test_an_eye_at_a_third_of_its_light_is_tracked_as_before(demo: Demo):
    estimates, truth = driven(demo, "right_dark")
    assert silent_wrong(estimates, truth) == []
    assert [each.status for each in estimates[1:]] == ["tracking"] * (FRAMES - 1)


def test_a_bump_is_said_in_its_second_frame_and_its_offset_is_learned(demo: Demo):
    estimates, _ = driven(demo, "columns_2")
    assert estimates[FRAMES // 2].status == "skipped"
    assert [k for k, each in enumerate(estimates) if Doubt.RIG in each.doubts] == [FRAMES // 2 + 1]
    before, after = estimates[FRAMES // 2 - 1].calibration, estimates[-1].calibration
    change = after.disparity_offset - before.disparity_offset
    sigma = np.hypot(before.disparity_offset_sigma, after.disparity_offset_sigma)
    assert change == pytest.approx(-2.0, abs=float(4.0 * sigma))


def test_an_image_that_is_shifted_once_is_skipped_and_changes_nothing(demo: Demo):
    """Taken for a bump and another one back, each began a map anew, up to 8 cm off in rooms."""
    estimates, truth = driven(demo, "left_shifted")
    shifted = range(5, FRAMES, 10)
    assert [k for k, each in enumerate(estimates) if each.status != "tracking"] == [0, *shifted]
    assert {estimates[k].status for k in shifted} <= {"skipped", "lost"}
    assert silent_wrong(estimates, truth) == []
    good, _ = driven(demo, "none")
    last = [np.linalg.norm(each[-1].T_world_camera[:3, 3] - truth[-1][:3, 3]) for each in (estimates, good)]
    assert last[0] < 1.5 * last[1] + 0.002


def find_bump(demo: Demo, before: float, change: Callable[[np.ndarray], np.ndarray]) -> RigChange | None:
    """What is found where the right image (H, W) changes after twelve frames with rows lower by `before` pixels."""
    camera, frames, _ = demo
    tracker = StereoTracker(camera)
    moved = [replace(each, right=shift_image(each.right, before, 0.0)) for each in frames[:13]]
    track(tracker, moved[:12])
    frame = Frame(*tracker.rectifier.rectify(moved[12].left, change(moved[12].right)), tracker._frontend)
    tracker._motion.predict(moved[12].timestamp - moved[11].timestamp, np.full(2, 1.0), timestamp=moved[12].timestamp)
    prediction = Prediction.of(tracker._window, tracker._motion)
    views = [each.view for each in tracker._keyframes.active]
    matches = tracker._localiser.guided.match_guided(frame.view, views, prediction.pose, prediction.covariance)
    return find_change(tracker._localiser, views[-1], frame, matches, prediction)


@pytest.mark.parametrize(("later", "change"), [(0.0, None), (-2.5, -2.5)])
def test_rows_that_were_off_before_are_no_bump(demo: Demo, later: float, change: float | None):
    """A frame that fails for another reason is asked for one."""
    found = find_bump(demo, 1.3, lambda right: shift_image(right, later, 0.0))
    assert (found is None) == (change is None)
    if found is not None:
        assert found.rows == pytest.approx(change, abs=0.3)
        assert found.columns == pytest.approx(0.0, abs=0.3)


def test_a_turn_that_moves_the_border_farther_is_a_bump(demo: Demo):
    K = demo[0].right.matrix
    turn = K @ cv2.Rodrigues(np.array([0.0, 12.0 / K[0, 0], 0.0]))[0] @ np.linalg.inv(K)
    found = find_bump(demo, 0.0, lambda right: cv2.warpPerspective(right, turn, right.shape[::-1]))
    assert found is not None
    assert found.columns == pytest.approx(-13.0, abs=1.5)  # 12 in the middle, 18 at the border
    assert found.rows == pytest.approx(0.0, abs=0.5)


@pytest.mark.parametrize("had_other_times", [False, True])
def test_a_jump_is_doubtful_once_images_of_another_time_came(demo: Demo, had_other_times: bool):
    camera, frames, _ = demo
    tracker = StereoTracker(camera)
    track(tracker, frames[:16])
    tracker._scrutiny._had_other_times = had_other_times
    tracker._motion.set_twist(np.zeros(6), np.full(6, 1e-6))
    (estimate,) = track(tracker, frames[16:17])
    assert tracker._motion.widened > 1.0
    assert list(estimate.doubts) == [Doubt.TIME] * had_other_times


@pytest.mark.parametrize(
    ("errors", "doubted"),
    [
        ([0.0, -0.7, 0.0, 0.0], [1, 2]),
        ([0.0, -0.7, -0.6, 0.0, 0.0], [1, 2, 3]),
        ([0.0, 0.8, -0.9, 0.0, 0.0], [1, 2, 3, 4]),
    ],
    ids=["braked", "braked for two frames", "to and fro"],
)
def test_a_shaken_camera_delivers_no_images_of_another_time(
    demo: Demo, monkeypatch: pytest.MonkeyPatch, errors: list[float], doubted: list[int]
):
    """A departure that does not come back is an acceleration: what motion does not expect later is no other time's."""
    camera, frames, _ = demo
    tracker = StereoTracker(camera)
    track(tracker, frames[:8])
    given = iter(errors)
    monkeypatch.setattr(scrutiny, "time_error", lambda *others: next(given))
    monkeypatch.setattr(scrutiny, "surprise", lambda *others: 1.5)
    found = track(tracker, frames[8 : 8 + len(errors)])
    assert [k for k, each in enumerate(found) if Doubt.TIME in each.doubts] == doubted


@pytest.mark.parametrize("doubt", ["streaked", "ambiguous"])
def test_frames_that_see_landmarks_of_a_doubted_keyframe_share_what_its_pose_leaves_out(
    demo: Demo, monkeypatch: pytest.MonkeyPatch, doubt: str
):
    """Poses are the same to the bit, and none is surer than without."""
    camera, frames, _ = demo
    insert = Mapper.insert_if_due

    def insert_doubted(mapper: Mapper, *given: Any) -> KeyframeTracks | None:
        given = *given[:2], replace(given[2], clustering=4.0), *given[3:]
        if doubt == "ambiguous":
            return insert(mapper, *given[:6], Doubts(spread=1e-6 * np.eye(6), is_ambiguous=True))
        return insert(mapper, *given[:4], replace(given[4], streaked=True), *given[5:])

    def insert_clustered(mapper: Mapper, *given: Any) -> KeyframeTracks | None:
        return insert(mapper, *given[:2], replace(given[2], clustering=4.0), *given[3:])

    runs = []
    for change in (insert_clustered, insert_doubted):
        monkeypatch.setattr(Mapper, "insert_if_due", change)
        runs.append(track(StereoTracker(camera), frames[:FRAMES]))
    first = next(k for k, each in enumerate(runs[0]) if k > 1 and each.tracks is not None)
    for k, (plain, doubted) in enumerate(zip(*runs, strict=True)):
        assert np.array_equal(plain.T_world_camera, doubted.T_world_camera)
        more = doubted.covariance - plain.covariance
        if k > first:
            assert np.linalg.eigvalsh(more)[-1] > 0.0
            assert np.linalg.eigvalsh(more)[0] > -1e-9 * np.trace(more)
        else:
            assert not more.any()


def test_keyframes_that_rest_on_a_drawn_one_are_uncertain_once_it_has_left(demo: Demo, monkeypatch: pytest.MonkeyPatch):
    """By as much as they rest on it, in all directions, as what moves draws on; frames without a pose are no surer."""
    camera, frames, _ = demo
    insert, found = Mapper.insert_if_due, []
    one_way = np.diag([0.0, 0.0, 1e-2, 0.0, 0.0, 0.0])
    for first in (Doubts(), Doubts(published=one_way, is_ambiguous=True), Doubts(spread=one_way, is_ambiguous=True)):
        made: list[KeyframeTracks] = []

        def insert_drawn(
            mapper: Mapper, *given: Any, first: Doubts = first, made: list[KeyframeTracks] = made
        ) -> KeyframeTracks | None:
            tracks = insert(mapper, *given[:6], Doubts() if made else first)
            made += [] if tracks is None else [tracks]
            return tracks

        monkeypatch.setattr(Mapper, "insert_if_due", insert_drawn)
        tracker = StereoTracker(camera, config=TrackerConfig(window=3, keyframe_ratio=1.0))
        last = track(tracker, frames)[-1]
        black = np.zeros_like(frames[0].left)
        lost = tracker.step(black, black, frames[-1].timestamp + 0.05)
        assert len(made) > 6
        covariances = last.covariance, tracker.final_trajectory()[1][len(frames) - 1], lost.covariance
        found.append([np.diag(each)[:3] for each in covariances])
    assert np.array_equal(found[0], found[1])
    for more in np.subtract(found[2], found[0]):
        np.testing.assert_allclose(more, more.mean(), rtol=0.01)
        assert 0.1 < more.sum() / np.trace(one_way) < 1.0


def test_what_neighbours_share_in_keyframes_makes_poses_less_certain_and_moves_none(
    demo: Demo, monkeypatch: pytest.MonkeyPatch
):
    camera, frames, _ = demo
    insert, runs = Mapper.insert_if_due, []
    for clustering in (1.0, 4.0):

        def insert_clustered(mapper: Mapper, *given: Any, factor: float = clustering) -> KeyframeTracks | None:
            fit = given[2]
            shared = replace(fit, clustering=factor, inflation=fit.inflation * factor / fit.clustering)
            return insert(mapper, *given[:2], shared, *given[3:])

        monkeypatch.setattr(Mapper, "insert_if_due", insert_clustered)
        runs.append(track(StereoTracker(camera), frames[:FRAMES]))
    last = [run[-1] for run in runs]
    for one, other in zip(*runs, strict=True):
        np.testing.assert_allclose(one.T_world_camera, other.T_world_camera, atol=1e-12)
        assert np.linalg.eigvalsh(other.covariance - one.covariance)[0] >= -1e-9 * np.trace(one.covariance)
    assert 1.5 < np.trace(last[1].matching_covariance) / np.trace(last[0].matching_covariance) < 4.0


def test_eyes_that_do_not_fit_make_all_poses_doubtful_and_less_certain(demo: Demo):
    camera, frames, _ = demo
    sure, unsure = StereoTracker(camera), StereoTracker(camera, disparity_error=2.0)
    for frame in frames[:6]:
        one, other = (each.step(frame.left, frame.right, frame.timestamp) for each in (sure, unsure))
        assert (one.status, other.status) in [("starting", "starting"), ("tracking", "doubtful")]
    assert list(other.doubts) == [Doubt.INPUT]
    assert np.trace(other.covariance[:3, :3]) > 2.0 * np.trace(one.covariance[:3, :3])


@pytest.mark.parametrize("fault", ["right_lags", "left_lags"])
def test_an_eye_that_is_a_frame_behind_is_doubtful(demo: Demo, fault: str):
    camera, frames, _ = demo
    right, left = (frames[:-1], frames[1:]) if fault == "right_lags" else (frames[1:], frames[:-1])
    tracker = StereoTracker(camera)
    pairs = [replace(one, right=other.right) for one, other in zip(left[:FRAMES], right[:FRAMES], strict=True)]
    estimates = track(tracker, pairs)
    first = next(k for k, each in enumerate(estimates) if Doubt.APART in each.doubts)
    assert first < 10
    assert all(each.status != "tracking" for each in estimates[first:])


def test_a_prediction_that_explains_the_image_does_not_give_way(demo: Demo):
    """What agrees with it may be the scene behind a mover that fills the view."""
    camera, frames, _ = demo
    tracker = StereoTracker(camera)
    track(tracker, frames[:12])
    tracker._motion.predict(frames[12].timestamp - frames[11].timestamp, np.full(2, 1e-4))
    frame = Frame(*tracker.rectifier.rectify(frames[12].left, frames[12].right), tracker._frontend)
    prediction, localiser = Prediction.of(tracker._window, tracker._motion), tracker._localiser
    views = [each.view for each in tracker._keyframes.active]
    near = localiser.guided.match_guided(frame.view, views, prediction.pose, prediction.covariance)
    assert localiser._fit_alone(near, near, prediction, prediction.pose, 1.0) is None
    assert localiser._fit_alone(near, GuidedMatches.empty(), prediction, prediction.pose, 1.0) is not None


def test_a_wrong_prediction_does_not_drag_along_a_pose_that_is_found_without_it(demo: Demo):
    camera, frames, truth = demo
    tracker = StereoTracker(camera)
    track(tracker, frames[:12])
    tracker._motion.set_twist(np.array([0.0, 0.0, 10.0, 0.0, 0.0, 0.0]), np.full(6, 1e-3))
    tracker._motion.predict(0.05, np.full(2, 1e-4))
    frame = Frame(*tracker.rectifier.rectify(frames[12].left, frames[12].right), tracker._frontend)
    prediction = Prediction.of(tracker._window, tracker._motion)
    views = [each.view for each in tracker._keyframes.active]
    matches, fit = tracker._localiser.localise(frame.view, views, prediction, False, Stopwatch())
    assert fit is not None
    assert fit.count > 0.8 * len(matches.probability)
    turned = tracker.rectifier.T_rectified_left
    true = turned @ se3_inverse(truth[0]) @ truth[12] @ se3_inverse(turned)
    assert np.linalg.norm(se3_log(fit.pose @ se3_inverse(true))) < 0.005
