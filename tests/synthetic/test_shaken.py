"""A shaken camera: what its flow does, that it keeps its way, and what a slow shutter makes of it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import rotation_log
from sigmaslam_synthetic.motion.paths import Path
from sigmaslam_synthetic.motion.random_motions import FreeSpace, drone, hand_held
from sigmaslam_synthetic.motion.shaken import shaken, slowed
from sigmaslam_synthetic.presets import PRESETS
from sigmaslam_synthetic.render_choices import CARRIED, PRESET_NAMES
from sigmaslam_synthetic.simulation import Recipe, Studio, simulate
from sigmaslam_synthetic.worlds.episode import Wish

DURATION, REACH = 6.0, 0.05
FOCAL, FPS = 460.0, 20.0
SLOW: dict[str, Callable[[np.random.Generator], Path]] = {
    "hand": lambda rng: hand_held(rng, 3.0, FreeSpace((0.0, 0.0, 1.5), (1.5, 1.2, 0.15))),
    "drone": lambda rng: drone(rng, 2.0, FreeSpace((0.0, 0.0, 3.0), (5.0, 4.0, 1.5))),
}


def make(carrier: str, seed: int) -> tuple[Path, Path]:
    """A slow path, and the same shaken."""
    rng = np.random.default_rng(seed)
    slow = slowed(SLOW[carrier](rng), DURATION)
    return slow, shaken(rng, slow, REACH)


def middle_flow(path: Path, times: np.ndarray) -> np.ndarray:
    """By how far the middle of the image moves across from each time to the next by turning, pixels."""
    R = path.poses(times)[:, :3, :3]
    return np.asarray(FOCAL * rotation_log(np.swapaxes(R[:-1], 1, 2) @ R[1:])[:, 1])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("carrier", SLOW)
def test_the_flow_reverses_within_half_a_second_between_peaks_of_25_to_45_pixels(carrier: str, seed: int) -> None:
    _, path = make(carrier, seed)
    flow = middle_flow(path, np.arange(0.0, DURATION, 1 / FPS))
    swings = np.split(np.arange(len(flow)), np.flatnonzero(np.diff(np.sign(flow))) + 1)[1:-1]
    assert len(swings) >= DURATION / 0.5
    peaks = np.array([swing[np.abs(flow[swing]).argmax()] for swing in swings])
    assert np.diff(peaks).max() / FPS <= 0.5
    heights = np.abs(flow[peaks])
    # A frame's flow is the mean over a twentieth of a second, which takes a few pixels off a short peak.
    assert (heights > 16).all()
    assert (heights < 48).all()
    assert 25 < np.median(heights) < 45
    assert heights.std() > 2


@pytest.mark.parametrize("carrier", SLOW)
def test_constant_velocity_foresees_little_of_the_flow(carrier: str) -> None:
    flow = middle_flow(make(carrier, 0)[1], np.arange(0.0, DURATION, 1 / FPS))
    slow = middle_flow(make(carrier, 0)[0], np.arange(0.0, DURATION, 1 / FPS))
    assert np.quantile(np.abs(np.diff(flow)), 0.9) > 10
    assert np.quantile(np.abs(np.diff(slow)), 0.9) < 2


def test_position_and_turning_are_smooth_to_the_second_derivative() -> None:
    _, path = make("hand", 1)
    for step in (4e-3, 1e-3):
        times = np.arange(0.0, DURATION, step)
        T = path.poses(times)
        push = np.diff(T[:, :3, 3], 2, axis=0) / step**2
        turn = rotation_log(np.swapaxes(T[:-1, :3, :3], 1, 2) @ T[1:, :3, :3]) / step
        jolt = np.diff(turn, axis=0) / step
        # A step of an acceleration would stay as high however short the time.
        assert np.linalg.norm(np.diff(push, axis=0), axis=1).max() < 250 * step
        assert np.linalg.norm(np.diff(jolt, axis=0), axis=1).max() < 1500 * step


def test_a_seed_gives_one_shaking_and_others_give_others() -> None:
    first, again, other = (make("hand", seed)[1].to_json() for seed in (1, 1, 2))
    assert first == again
    assert first != other
    slow, _ = make("hand", 0)
    two = [shaken(np.random.default_rng(seed), slow, REACH).to_json() for seed in (1, 2)]
    assert two[0] != two[1]


@pytest.mark.parametrize("carrier", SLOW)
def test_the_way_is_that_of_the_slow_path_but_for_the_reach(carrier: str) -> None:
    slow, path = make(carrier, 3)
    times = np.linspace(0.0, DURATION, 500)
    off = path.poses(times)[:, :3, 3] - slow.poses(times)[:, :3, 3]
    assert np.abs(off).max() <= REACH
    assert off.std(axis=0).min() > 0.1 * REACH
    speed = np.linalg.norm(np.diff(off, axis=0), axis=1) / (times[1] - times[0])
    assert np.median(speed) > 0.08


@pytest.mark.parametrize("preset", CARRIED)
def test_the_worlds_carry_a_shaken_camera(preset: str) -> None:
    assert pytest.approx(PRESETS[preset].focal * PRESETS[preset].fps, rel=0.01) == FOCAL * FPS
    wish = Wish(3.0, "shaken", movers=0.2, textures=1)
    first, again = (PRESETS[preset].generate(np.random.default_rng(3), wish) for _ in range(2))
    assert first.path.to_json() == again.path.to_json()
    assert first.scene.moving.any()
    flow = middle_flow(first.path, np.arange(0.0, 3.0, 1 / FPS))
    assert 25 < flow.max() < 52
    assert 25 < -flow.min() < 52


@pytest.mark.parametrize("preset", sorted(set(PRESET_NAMES) - set(CARRIED)))
def test_a_camera_that_nobody_carries_is_not_shaken(preset: str) -> None:
    with pytest.raises(InputError, match=rf"shaken goes with room, drone, rubble.*not with {preset}"):
        Recipe(preset, 3, motion="shaken").check()


@pytest.mark.long
@pytest.mark.parametrize("preset", CARRIED)
def test_the_slow_shutter_blurs_by_5_to_25_pixels_in_both_eyes_at_the_peak(preset: str) -> None:
    simulation = simulate(Recipe(preset, 12, 5, "shaken", sensor="slow"))
    numbers = np.arange(12)
    flow = np.abs(middle_flow(simulation.path, np.arange(13) / simulation.fps))
    studio = Studio(simulation)
    peak = int(numbers[flow.argmax()])
    times = np.array([peak, peak + 1]) / simulation.fps
    T = simulation.path.poses(times)
    # Points 3 m ahead of each eye, and where they are in the next frame.
    for eye, offset in ((studio.left, np.eye(4)), (studio.right, simulation.rig.true_right_pose)):
        camera = eye.camera
        v, u = np.mgrid[40 : camera.height - 40 : 40, 40 : camera.width - 40 : 40].reshape(2, -1)
        pixels = np.stack([u, v], axis=-1).astype(float)
        now, later = T[0] @ offset, T[1] @ offset
        points = 3.0 * camera.unproject(pixels) @ now[:3, :3].T + now[:3, 3]
        seen = (points - later[:3, 3]) @ later[:3, :3]
        blur = simulation.sensor.shutter * np.linalg.norm(camera.project(seen) - pixels, axis=-1)
        assert 5 < np.median(blur) < 25


@pytest.mark.parametrize("preset", CARRIED)
def test_what_moves_does_not_shake_with_the_camera(preset: str) -> None:
    episode = PRESETS[preset].generate(np.random.default_rng(3), Wish(3.0, "shaken", movers=0.2, textures=1))
    times = np.arange(0.0, 3.0, 0.05)
    for body in episode.scene.bodies:
        if body.path is not None:
            jerk = np.diff(body.path.poses(times)[:, :3, 3], 2, axis=0)
            assert np.linalg.norm(jerk, axis=1).max() < 0.015
    turn = episode.path.poses(times)[:, :3, 2]
    assert np.linalg.norm(np.diff(turn, 2, axis=0), axis=1).max() > 0.02
