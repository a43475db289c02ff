from collections.abc import Callable
from pathlib import Path as FilePath

import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import rotation_log
from sigmaslam.readers.trajectory_files import read_kitti
from sigmaslam_synthetic.motion.paths import Path, with_stops
from sigmaslam_synthetic.motion.random_motions import (
    CAMERA_HEIGHT,
    FreeSpace,
    closed_loop,
    drive,
    drive_profile,
    drone,
    hand_held,
    insertion,
    inspect,
    pure_rotation,
    rolling,
    tool,
)
from sigmaslam_synthetic.simulation import Recipe

Generator = Callable[[np.random.Generator], Path]

ROOM = FreeSpace((1.0, -2.0, 1.5), (1.6, 1.1, 0.25))
HALL = FreeSpace((0.0, 0.0, 3.0), (6.0, 5.0, 2.0))
BEND = np.linspace(0, 1, 20)
TUBE = np.stack([0.2 * BEND, 0.04 * np.sin(4 * BEND), 0.05 * np.cos(5 * BEND)], axis=-1)
RADIUS = 0.012

# Each with bounds on speed (m/s), acceleration (m/s^2), angular rate (deg/s) and angular acceleration (deg/s^2).
GENERATORS: dict[str, tuple[Generator, tuple[float, float, float, float]]] = {
    "hand held": (lambda rng: hand_held(rng, 20, ROOM), (0.9, 4, 45, 400)),
    "drone": (lambda rng: drone(rng, 20, HALL), (3.3, 5, 120, 500)),
    "drive": (lambda rng: drive(rng, 60), (18, 6, 60, 200)),
    "insertion": (lambda rng: insertion(rng, 20, TUBE, RADIUS), (0.03, 0.6, 60, 600)),
    "inspect": (lambda rng: inspect(rng, 20, 0.1, 0.08), (0.1, 0.8, 60, 600)),
    "tool": (lambda rng: tool(rng, 20, (0.0, 0.0, 0.1), 0.04), (0.3, 2, 150, 900)),
    "pure rotation": (lambda rng: pure_rotation(rng, 20, (1.0, 2.0, 3.0)), (1e-9, 1e-6, 40, 200)),
    "closed loop": (lambda rng: closed_loop(rng, 20, ROOM), (1.5, 3, 90, 400)),
}


def motion(path: Path, step: float = 0.01) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses (N, 4, 4), velocity (N, 3) in m/s, angular rate (N - 1, 3) in deg/s, at even times."""
    T = path.poses(np.arange(path.start, path.end, step))
    turn = np.swapaxes(T[:-1, :3, :3], 1, 2) @ T[1:, :3, :3]
    return T, np.gradient(T[:, :3, 3], step, axis=0), np.rad2deg(rotation_log(turn)) / step


def largest(vectors: np.ndarray) -> float:
    return float(np.linalg.norm(vectors, axis=-1).max())


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", GENERATORS)
def test_motion_is_bounded_and_without_jumps(name: str, seed: int) -> None:
    generate, (fastest, hardest, turning, jolting) = GENERATORS[name]
    path = generate(np.random.default_rng(seed))
    assert path.start == 0.0
    np.testing.assert_allclose(path.end, 60 if name == "drive" else 20, rtol=1e-12)
    _, velocity, rate = motion(path)
    assert largest(velocity) < fastest
    assert largest(np.diff(velocity, axis=0)) / 0.01 < hardest
    assert 1.0 < largest(rate) < turning
    # A jump of the rate would show as its height over the step.
    assert largest(np.diff(rate, axis=0)) / 0.01 < jolting


@pytest.mark.parametrize("name", GENERATORS)
def test_the_same_seed_gives_the_same_path(name: str) -> None:
    generate, _ = GENERATORS[name]
    first, again, other = (generate(np.random.default_rng(seed)).to_json() for seed in (1, 1, 2))
    assert first == again
    assert first != other


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("half", [(1.6, 1.1, 0.25), (0.4, 0.3, 0.02), (20.0, 15.0, 0.2)])
def test_hand_held_and_drone_stay_in_their_box(half: tuple[float, float, float], seed: int) -> None:
    box = FreeSpace((1.0, -2.0, 1.5), half)
    for path in (hand_held(np.random.default_rng(seed), 15, box), drone(np.random.default_rng(seed), 15, box)):
        T, _, _ = motion(path, 0.02)
        assert (np.abs(T[:, :3, 3] - box.centre) <= box.half).all()
        assert np.ptp(T[:, :3, 3], axis=0).max() > 0.3 * min(half[0], 3.0)


@pytest.mark.parametrize("seed", range(3))
def test_a_person_walks_at_walking_speed_with_the_camera_upright(seed: int) -> None:
    T, velocity, _ = motion(hand_held(np.random.default_rng(seed), 30, FreeSpace((0, 0, 1.5), (4, 3, 0.2))))
    speed = np.linalg.norm(velocity, axis=1)
    assert 0.3 < np.median(speed) < 0.8
    assert (speed > 0.3).mean() > 0.8
    assert (T[:, 2, 1] < -0.7).all()  # y is down
    bounce = velocity[:, 2] - velocity[:, 2].mean()
    assert 0.01 < bounce.std() < 0.2


@pytest.mark.parametrize("seed", range(3))
def test_a_drone_is_fast_turns_hard_and_leans_into_its_acceleration(seed: int) -> None:
    T, velocity, rate = motion(drone(np.random.default_rng(seed), 60, HALL))
    assert largest(velocity) > 1.2
    assert 35 < largest(rate) < 120
    push = np.gradient(velocity, 0.01, axis=0)
    right = T[:, :3, 0] * [1, 1, 0]
    sideways = (push * right).sum(axis=1) / np.linalg.norm(right, axis=1)
    # The right side sinks by the share of gravity.
    assert np.corrcoef(sideways, -T[:, 2, 0])[0, 1] > 0.95


def test_drives_have_the_statistics_of_kitti() -> None:
    drives = [motion(drive(np.random.default_rng(seed), 120), 0.1) for seed in range(12)]
    for T, _, _ in drives:
        np.testing.assert_allclose(T[0, :3, 3], [0, 0, CAMERA_HEIGHT], atol=1e-12)
        np.testing.assert_allclose(T[0, 1, 2], 0, atol=1e-9)
    speeds = [np.linalg.norm(velocity, axis=1) for _, velocity, _ in drives]
    town = [k for k, speed in enumerate(speeds) if np.median(speed) < 12]
    assert 6 <= len(town) < 12
    speed = np.concatenate([speeds[k] for k in town])
    assert 6.5 < np.median(speed) < 9
    assert 9.5 < np.quantile(speed, 0.95) < 12.5
    acceleration = np.concatenate([np.gradient(speeds[k], 0.1) for k in town])
    assert 0.8 < acceleration.std() < 1.25
    yaw_rate = np.concatenate([np.abs(drives[k][2][:, 1]) for k in town])
    assert 0.15 < (yaw_rate > 8).mean() < 0.28
    assert 25 < np.quantile(yaw_rate, 0.99) < 40
    pitch_rate, roll_rate = (np.concatenate([drives[k][2][:, i] for k in town]).std() for i in (0, 2))
    assert 1.2 < pitch_rate < 2.0
    assert 0.9 < roll_rate < 1.6
    assert 0.005 < np.mean(np.concatenate(speeds) < 1e-6) < 0.12  # at lights


def test_a_profile_is_a_stretch_of_the_real_drive(real_data: FilePath) -> None:
    file = real_data / "kitti_gt_trajectories" / "07.txt"
    path = drive_profile(file, 30.0, np.random.default_rng(4))
    T = path.poses(np.arange(0, 30, 0.1))
    np.testing.assert_allclose(T[0, :3, 3], [0, 0, CAMERA_HEIGHT], atol=1e-12)
    np.testing.assert_allclose(T[0, 1, 2], 0, atol=1e-12)
    assert T[0, 0, 2] > 0.99
    assert (T[:, 2, 1] < -0.95).all()
    # Poses relative to the first do not know of the world's axes: they must be found in the file.
    real = read_kitti(file).poses
    relative = np.linalg.inv(T[0]) @ T[200]
    there = np.linalg.inv(real[:-200]) @ real[200:]
    assert np.abs(there[:, :3, 3] - relative[:3, 3]).max(axis=1).min() < 0.15
    first = int(np.abs(there[:, :3, 3] - relative[:3, 3]).max(axis=1).argmin())
    np.testing.assert_allclose(there[first], relative, atol=0.15)
    with pytest.raises(InputError, match=r"07\.txt.*1101 lines lasts 110\.0 s, 200"):
        drive_profile(file, 200.0, np.random.default_rng(0))


def test_a_wrong_pose_file_is_named_with_line_and_mend(tmp_path: FilePath) -> None:
    file = tmp_path / "poses.txt"
    row = "1 0 0 0 0 1 0 0 0 0 1 0\n"
    file.write_text(row * 30 + "1 0 0 oops 0 1 0 0 0 0 1 0\n")
    with pytest.raises(InputError, match=r"poses\.txt.*line 31.*'oops'.*correct"):
        drive_profile(file, 1.0, np.random.default_rng(0))
    with pytest.raises(InputError, match=r"missing\.txt"):
        drive_profile(tmp_path / "missing.txt", 1.0, np.random.default_rng(0))


@pytest.mark.parametrize("seed", range(3))
def test_an_endoscope_stays_in_its_tube_and_looks_along_it(seed: int) -> None:
    T, velocity, _ = motion(insertion(np.random.default_rng(seed), 40, TUBE, RADIUS), 0.02)
    fine = np.linspace(0, 1, 4000)
    axis = np.stack([0.2 * fine, 0.04 * np.sin(4 * fine), 0.05 * np.cos(5 * fine)], axis=-1)
    apart = np.linalg.norm(T[:, None, :3, 3] - axis[::8], axis=-1)
    assert apart.min(axis=1).max() < 0.6 * RADIUS
    nearest = apart.argmin(axis=1) * 8
    tangent = np.gradient(axis, axis=0)[nearest]
    cosine = (T[:, :3, 2] * tangent).sum(axis=1) / np.linalg.norm(tangent, axis=1)
    assert np.median(cosine) > 0.9
    assert cosine.min() > 0.6
    assert 0.004 < np.median(np.linalg.norm(velocity, axis=1)) < 0.021


@pytest.mark.parametrize("seed", range(3))
def test_an_inspection_hovers_over_the_surface_and_sees_it(seed: int) -> None:
    T, _, _ = motion(inspect(np.random.default_rng(seed), 30, 0.1, 0.08))
    assert (np.abs(T[:, :2, 3]) <= 0.08).all()
    assert (np.abs(T[:, 2, 3] - 0.1) <= 0.025).all()
    slant = np.rad2deg(np.arccos(-T[:, 2, 2]))
    assert 3 < slant.max() < 28


@pytest.mark.parametrize("seed", range(3))
def test_a_tool_stays_in_reach_and_rests(seed: int) -> None:
    path = tool(np.random.default_rng(seed), 30, (0.1, 0.0, 0.2), 0.05)
    T, velocity, rate = motion(path)
    assert largest(T[:, :3, 3] - [0.1, 0.0, 0.2]) <= 0.05
    assert len(path.stops) == 3
    resting = np.linalg.norm(velocity, axis=1) < 1e-12
    assert resting.sum() * 0.01 > sum(stop.hold for stop in path.stops) - 0.1
    assert largest(rate[resting[:-1] & resting[1:]]) < 1e-5


def test_pure_rotation_does_not_move() -> None:
    T, _, rate = motion(pure_rotation(np.random.default_rng(0), 20, (1.0, 2.0, 3.0)))
    np.testing.assert_allclose(T[:, :3, 3], np.broadcast_to([1.0, 2.0, 3.0], (len(T), 3)), atol=1e-12)
    assert largest(rate) > 15


@pytest.mark.parametrize("seed", range(3))
def test_a_closed_loop_ends_as_it_began(seed: int) -> None:
    path = closed_loop(np.random.default_rng(seed), 30, ROOM)
    np.testing.assert_allclose(path.poses(30.0), path.poses(0.0), atol=1e-12)
    T, velocity, rate = motion(path, 0.01)
    np.testing.assert_allclose(velocity[-1], velocity[0], atol=0.02)
    np.testing.assert_allclose(rate[-1], rate[0], atol=2.0)
    assert (np.abs(T[:, :3, 3] - ROOM.centre) <= ROOM.half).all()
    assert largest(T[1500, :3, 3] - T[0, :3, 3]) > 1.0


@pytest.mark.parametrize("seed", range(3))
def test_a_robot_with_wheels_drives_where_it_looks_and_stays_level(seed: int) -> None:
    path = rolling(np.random.default_rng(seed), 20, ROOM)
    t = np.linspace(0.01, 19.99, 4000)
    T = path.poses(t)
    velocity = (path.poses(t + 1e-3)[:, :3, 3] - path.poses(t - 1e-3)[:, :3, 3]) / 2e-3
    ahead = T[:, :3, 2]
    np.testing.assert_allclose(T[:, 2, 3], ROOM.centre[2], atol=1e-9)
    np.testing.assert_allclose(T[:, :3, 1], np.tile([0.0, 0.0, -1.0], (len(t), 1)), atol=1e-9)
    speed = np.linalg.norm(velocity, axis=1)
    assert speed.min() > 0.25
    assert speed.max() < 0.55
    # Wheels do not slide sideways: no more than the spline between the knots lets them.
    assert np.abs(np.cross(velocity, ahead)[:, 2]).max() < 1e-3 * speed.max()
    assert (np.abs(T[:, :2, 3] - ROOM.centre[:2]) <= ROOM.half[:2]).all()


def test_only_a_room_has_a_floor_to_drive_on() -> None:
    with pytest.raises(InputError, match=r"planar goes with room"):
        Recipe("drone", 3, motion="planar").check()


def test_stops_hold_a_walk_still() -> None:
    rng = np.random.default_rng(0)
    path = with_stops(hand_held(rng, 20, ROOM), rng, 2)
    _, velocity, rate = motion(path)
    resting = np.linalg.norm(velocity, axis=1) < 1e-12
    assert resting.sum() * 0.01 > 1.9
    assert largest(rate[resting[:-1] & resting[1:]]) < 1e-5


def test_a_path_without_room_or_time_is_refused() -> None:
    with pytest.raises(InputError, match="room to move"):
        hand_held(np.random.default_rng(0), 10, FreeSpace((0, 0, 0), (0.01, 0.01, 0.01)))
    with pytest.raises(InputError, match="duration"):
        drone(np.random.default_rng(0), 0.0, HALL)
