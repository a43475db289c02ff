"""Faults that need scenes of their own, rendered here: turning on the spot, a truck, half of all matches on movers.

The right status, and never a confident wrong pose, as in `test_faults`.
"""

from dataclasses import replace

import numpy as np
import pytest

from tests.support.estimates import error_of, statuses, track
from tests.support.faults import assert_honest

torch = pytest.importorskip("torch")

from sigmaslam.geometry.se3 import se3_inverse  # noqa: E402
from sigmaslam.readers import StereoFrame  # noqa: E402
from sigmaslam.slam.tracker import Estimate, StereoTracker  # noqa: E402
from sigmaslam_synthetic.camera.sensor import expose  # noqa: E402
from sigmaslam_synthetic.motion.paths import Path  # noqa: E402
from sigmaslam_synthetic.simulation import Recipe, Simulation, Studio, simulate  # noqa: E402


def filmed(simulation: Simulation) -> tuple[list[StereoFrame], np.ndarray]:
    """All pairs, each with a mask of what moves on its own, and its share of each left image."""
    studio = Studio(simulation)
    moving = np.append(simulation.scene.moving, False)  # the last one is the sky, -1
    sensor = replace(simulation.sensor, shutter=0.0)
    frames, shares = [], []
    for k, time in enumerate(simulation.times):
        with torch.inference_mode():
            views = studio.views(np.array([k]))
        images = [
            expose(each.image[0].numpy(), sensor, np.random.default_rng((simulation.seed, k, eye)))
            for eye, each in enumerate(views)
        ]
        moves = moving[views[0].body[0].numpy()]
        shares.append(moves.mean())
        frames.append(StereoFrame(k, float(time), images[0], images[1], ~moves))
    return frames, np.array(shares)


def tracked(simulation: Simulation, frames: list[StereoFrame]) -> tuple[list[Estimate], np.ndarray]:
    """Estimates, and the true poses in the world of the first one."""
    poses = simulation.path.poses(simulation.times)
    return track(StereoTracker(simulation.rig.calibrated), frames), se3_inverse(poses[0]) @ poses


def passing(simulation: Simulation, begins: float, aside: float) -> Simulation:
    """What moves comes into view from the left, stays for a while and leaves to the right.

    Args:
        simulation: with bodies that move on their own.
        begins: seconds; 0.7 s later they are where they would be else, for 0.7 s, and 0.7 s later they are gone.
        aside: metres to the side where they come from and go to.
    """
    times = np.linspace(0.0, simulation.times[-1], 2 * simulation.frames)
    across = aside * np.interp(times, begins + 0.7 * np.arange(4), [-1.0, 0.0, 0.0, 1.0])
    way = across[:, None] * simulation.path.poses(times)[:, :3, 0]

    def moved(path: Path) -> Path:
        poses = path.poses(times)
        poses[:, :3, 3] += way
        return Path.from_poses(times, poses)

    bodies = [body if body.path is None else replace(body, path=moved(body.path)) for body in simulation.scene.bodies]
    return replace(simulation, scene=replace(simulation.scene, bodies=tuple(bodies)))


def assert_not_followed(simulation: Simulation) -> None:
    """Bodies that cover nearly half the image for a while do no harm, and tracking goes on after them."""
    frames, shares = filmed(simulation)
    assert shares.max() > 0.45
    estimates, truth = tracked(simulation, frames)
    assert_honest(estimates, truth)
    assert statuses(estimates[-5:]) == ["tracking"] * 5


@pytest.mark.slow
def test_turning_on_the_spot_is_a_rotation_alone():
    """40 degrees to the right and back in 1.5 s, then a way of 0.2 m that begins and ends gently."""
    room = simulate(Recipe("room", 42, seed=3, motion="rest", width=320, height=240))
    t = room.times
    angle = np.deg2rad(20.0) * (1.0 - np.cos(2.0 * np.pi * np.clip(t / 1.5, 0.0, 1.0)))
    way = 0.1 * (1.0 - np.cos(np.pi * np.clip((t - 1.5) / 0.6, 0.0, 1.0)))
    turned = np.tile(np.eye(4), (len(t), 1, 1))
    turned[:, 0, 0] = turned[:, 2, 2] = np.cos(angle)
    turned[:, 0, 2], turned[:, 2, 0] = np.sin(angle), -np.sin(angle)
    turned[:, 0, 3] = way
    simulation = replace(room, path=Path.from_poses(t, room.path.poses(0.0) @ turned))
    estimates, truth = tracked(simulation, filmed(simulation)[0])
    assert statuses(estimates[1:]) == ["tracking"] * 41
    assert_honest(estimates, truth)
    # On the spot: what is reported as a way is noise.
    assert max(np.linalg.norm(estimate.T_world_camera[:3, 3]) for estimate in estimates[:30]) < 0.02


@pytest.mark.slow
@pytest.mark.xfail(reason="of three draws of noise one or two follow it, 470 to 1,080 squared sigmas")
def test_a_truck_that_comes_to_fill_half_the_image_is_not_followed():
    """It cuts in from the left, drives ahead at the camera's own speed for 0.7 s, and leaves."""
    simulation = passing(simulate(Recipe("street", 30, seed=2, movers=0.5, width=640, height=192)), 0.6, 14.0)
    assert_not_followed(simulation)


@pytest.mark.slow
@pytest.mark.xfail(reason="of three draws of noise two stay `ambiguous` to the end; 14 squared sigmas at most")
def test_people_that_come_to_fill_half_the_image_are_not_followed():
    """They walk into a room that is being filmed, keep in front of the camera for 0.7 s, and leave."""
    simulation = passing(simulate(Recipe("room", 52, seed=1, movers=0.5, width=320, height=240)), 0.3, 3.0)
    assert_not_followed(simulation)


@pytest.mark.slow
@pytest.mark.xfail(reason="in renders by torch's AVX2 kernels movers are followed, in five of five draws")
def test_half_the_image_on_movers_from_the_first_frame_is_not_followed():
    """No prediction says which half stands still, and as many matches are on the one as on the other."""
    simulation = simulate(Recipe("street", 8, seed=2, movers=0.5, width=640, height=192))
    frames, shares = filmed(simulation)
    assert shares.min() > 0.4
    estimates, truth = tracked(simulation, frames)
    assert_honest(estimates, truth)


@pytest.mark.slow
def test_two_motions_that_part_on_are_both_in_the_covariance():
    """The same, four frames: where movers are followed, the scene is seen to be left behind in the second one alone."""
    simulation = simulate(Recipe("street", 8, seed=2, movers=0.5, width=640, height=192))
    estimates, truth = tracked(simulation, filmed(simulation)[0][:4])
    assert_honest(estimates, truth[:4])


@pytest.mark.slow
def test_movers_that_are_masked_do_no_harm():
    """People in half of a room's image: masked by their own pixels, as good as if they were not there."""
    simulation = simulate(Recipe("room", 20, seed=1, movers=0.5, width=320, height=240))
    frames, shares = filmed(simulation)
    assert shares.min() > 0.4
    bodies = tuple(body for body in simulation.scene.bodies if body.path is None)
    empty = replace(simulation, scene=replace(simulation.scene, bodies=bodies))
    seen, truth = tracked(empty, filmed(empty)[0])
    tracker = StereoTracker(simulation.rig.calibrated)
    masked = [tracker.step(frame.left, frame.right, frame.timestamp, frame.mask) for frame in frames]
    assert_honest(masked, truth)
    errors = [
        max(np.linalg.norm(error_of(*each)[:3]) for each in zip(run, truth, strict=True)) for run in (seen, masked)
    ]
    assert errors[1] < 2.0 * errors[0] + 0.002
    assert statuses(masked[1:]) == ["tracking"] * 19


@pytest.mark.slow
def test_a_shutter_open_five_times_as_long_is_survived():
    """In a drive: the second ten of 30 frames are blurred by 11 to 16 px in the median, along their own flow."""
    simulation = simulate(Recipe("street", 30, seed=1, width=640, height=192))
    shutter = simulation.sensor.shutter
    frames = []
    for k, time in enumerate(simulation.times):
        sensor = replace(simulation.sensor, shutter=5.0 * shutter if 10 <= k < 20 else shutter)
        with torch.inference_mode():
            shot = Studio(replace(simulation, sensor=sensor)).frames(np.array([k]))[0]
        frames.append(StereoFrame(k, float(time), shot.left, shot.right))
    estimates, truth = tracked(simulation, frames)
    assert_honest(estimates, truth)
    assert statuses(estimates[1:]) == ["tracking"] * 29


@pytest.mark.slow
def test_a_body_that_travels_along_does_not_draw_the_pose():
    """An eighth of a shaken drone's image, near, and about as fast: before it left the map, 0.11 m at frame 13."""
    simulation = simulate(Recipe("drone", 40, 9001, "shaken", 0.2, "slow", width=376, height=240))
    studio = Studio(simulation)
    with torch.inference_mode():
        shots = [studio.frames(np.array([k]))[0] for k in range(14)]
    frames = [
        StereoFrame(k, float(t), shot.left, shot.right)
        for k, (t, shot) in enumerate(zip(simulation.times, shots, strict=False))
    ]
    estimates, truth = tracked(simulation, frames)
    assert_honest(estimates[3:], truth[3:])
    assert np.linalg.norm(error_of(estimates[-1], truth[13])[:3]) < 0.03
    assert "ambiguous" in statuses(estimates)
