"""Pairs of 3D scenes as a stream; the worlds themselves are tested elsewhere, here a small one stands for all."""

import cv2
import numpy as np
import pytest

from sigmaslam_synthetic import scene_pairs
from sigmaslam_synthetic.camera.sensor import Sensor
from sigmaslam_synthetic.motion.paths import Path
from sigmaslam_synthetic.scene_pairs import ScenePair, ScenePairs
from sigmaslam_synthetic.worlds.episode import Episode, Wish
from tests.support.small_worlds import camera_pose, small_scene


def small_world(rng: np.random.Generator, wish: Wish) -> Episode:
    poses = np.stack([camera_pose((0.1 * k, 0.3 * np.sin(k), 1.2 + 0.05 * rng.random())) for k in range(9)])
    return Episode(small_scene(), Path.from_poses(np.linspace(0, wish.duration, 9), poses))


@pytest.fixture(autouse=True)
def one_small_world(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_pairs, "DOMAINS", {"small": small_world})
    monkeypatch.setattr(scene_pairs, "_VIEWS", 4)


def stream(seed: int = 3) -> ScenePairs:
    return ScenePairs(seed, 96, ("small",))


def assert_equal(a: ScenePair, b: ScenePair) -> None:
    np.testing.assert_array_equal(a.image0, b.image0)
    np.testing.assert_array_equal(a.image1, b.image1)


@pytest.mark.long
def test_a_pair_does_not_depend_on_what_was_asked_before() -> None:
    forward, backward = stream(), stream()
    indices = [0, 1, 8, 600, 1]
    found = [forward.pair(i) for i in indices]
    for i, pair in zip(reversed(indices), reversed(found), strict=True):
        assert_equal(backward.pair(i), pair)
    assert np.abs(stream(4).pair(0).image0 - found[0].image0).mean() > 1e-3


def test_no_two_pairs_and_no_two_scenes_share_their_random_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    named, default_rng = [], np.random.default_rng
    monkeypatch.setattr(np.random, "default_rng", lambda name=None: named.append(name) or default_rng(name))
    monkeypatch.setattr(ScenePairs, "_views", lambda self, scene: [None] * 4)
    monkeypatch.setattr(ScenePairs, "_overlap", lambda self, a, b: 1.0)
    monkeypatch.setattr(ScenePairs, "_photograph", lambda self, views, rng, sensor: None)
    for seed in range(3):
        for index in range(40):
            stream(seed).pair(index)
    assert len(named) == len(set(named)) == 120


def test_neighbours_see_other_scenes_and_every_scene_is_replaced() -> None:
    pairs = stream()
    scenes = [pairs._scene_of(index) for index in range(4096)]
    assert len(set(scenes[:8])) == 8
    uses = np.bincount(scenes)
    assert uses.max() <= scene_pairs._USES
    # After the beginning one scene is replaced at a time, so that rendering takes its time evenly.
    first_seen = sorted({scene: index for index, scene in reversed(list(enumerate(scenes)))}.values())
    assert np.diff(first_seen[8:]).min() > 20


@pytest.mark.long
def test_points_move_to_where_the_same_thing_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    clean = Sensor(blur=0.0, read_noise=0.0, photons_at_white=1e9)
    monkeypatch.setattr(scene_pairs, "random_sensor", lambda rng: clean)
    correlations, hidden = [], 0
    pairs = stream()
    for index in range(6):
        pair = pairs.pair(index)
        v, u = np.mgrid[8:88:2, 8:88:2]
        points = np.stack([u.ravel(), v.ravel()], axis=-1).astype(float)
        places, visible = pair.transfer(points)
        hidden += int((~visible).sum())
        if visible.sum() < 100:
            continue
        where = places[visible].astype(np.float32)
        there = cv2.remap(pair.image1, where[:, 0], where[:, 1], cv2.INTER_LINEAR).ravel()
        here = pair.image0[points[visible, 1].astype(int), points[visible, 0].astype(int)]
        correlations.append(np.corrcoef(here, there)[0, 1])
    assert len(correlations) >= 3
    assert np.median(correlations) > 0.9
    assert hidden > 50


@pytest.mark.long
def test_eyes_of_a_stereo_pair_see_the_same_on_one_row_the_right_one_further_left() -> None:
    pairs = ScenePairs(3, 96, ("small",), stereo=True)
    for index in range(4):
        v, u = np.mgrid[8:88:4, 8:88:4]
        points = np.stack([u.ravel(), v.ravel()], axis=-1).astype(float)
        places, visible = pairs.pair(index).transfer(points)
        assert visible.sum() > 100
        shift = (places - points)[visible]
        np.testing.assert_allclose(shift[:, 1], 0.0, atol=1e-3)
        assert shift[:, 0].max() < 0.0


def test_an_unknown_domain_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown domain"):
        ScenePairs(0, 96, ("moon",))


@pytest.mark.long
def test_forward_motion_is_along_the_axis_through_one_camera_and_back() -> None:
    pairs = ScenePairs(3, 96, ("small",), forward=True)
    steps = []
    for index in range(16):
        views0, views1 = pairs.pair(index).views0, pairs.pair(index).views1
        assert views0.sight.eye.camera == views1.sight.eye.camera
        T_1_0 = views1.sight.T_view_mover[0, 0] @ np.linalg.inv(views0.sight.T_view_mover[0, 0])
        step = np.asarray(T_1_0[:3, 3])
        assert abs(step[2]) > 2.0 * np.hypot(*step[:2])
        assert np.trace(T_1_0[:3, :3]) > 1.0 + 2.0 * np.cos(np.deg2rad(6.0))
        steps.append(step[2])
    assert 3 <= (np.array(steps) < 0).sum() <= 13


def test_a_pair_is_not_of_two_eyes_and_of_forward_motion() -> None:
    with pytest.raises(ValueError, match="stereo or forward"):
        ScenePairs(3, 96, ("small",), stereo=True, forward=True)
