import json

import numpy as np
import pytest

from sigmaslam.geometry.se3 import rotation_exp, rotation_log
from sigmaslam_synthetic.geometry import arc_length
from sigmaslam_synthetic.motion.paths import (
    LARGEST_NOISE,
    Path,
    Stop,
    at_rest,
    carried_frames,
    noise,
    padded_clock,
    smooth_to_rate,
    view_rotations,
    wandering_curve,
    with_stops,
)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def winding(rng: np.random.Generator) -> Path:
    """A path of 10 s through random knots, turning all around."""
    times = np.linspace(1.0, 11.0, 41)
    turns = np.cumsum(rng.normal(size=(41, 3)) * 0.4, axis=0)
    return Path(times, np.cumsum(rng.normal(size=(41, 3)), axis=0), turns)


def rates(path: Path, t: np.ndarray, h: float = 1e-5) -> tuple[np.ndarray, np.ndarray]:
    """Velocity (N, 3) and angular rate (N, 3) by central differences."""
    before, after = path.poses(t - h), path.poses(t + h)
    velocity = (after[:, :3, 3] - before[:, :3, 3]) / (2 * h)
    turn = np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]
    return velocity, rotation_log(turn) / (2 * h)


def test_a_path_passes_through_its_knots(winding: Path) -> None:
    T = winding.poses(winding.times)
    np.testing.assert_allclose(T[:, :3, 3], winding.positions, atol=1e-12)
    np.testing.assert_allclose(T[:, :3, :3], rotation_exp(winding.rotations), atol=1e-12)
    np.testing.assert_array_equal(T[:, 3], np.broadcast_to([0, 0, 0, 1.0], (41, 4)))


def test_rotations_stay_rotations_and_shapes_follow_the_times(winding: Path) -> None:
    T = winding.poses(np.linspace(0, 12, 60).reshape(3, 20))
    assert T.shape == (3, 20, 4, 4)
    assert winding.poses(2.0).shape == (4, 4)
    R = T[..., :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    np.testing.assert_array_equal(winding.poses(2.0), winding.poses(np.array([1.5, 2.0]))[1])


def test_velocity_acceleration_and_angular_rate_do_not_jump_at_knots(winding: Path) -> None:
    knots = winding.times[1:-1]
    h = 1e-4
    before, after = (rates(winding, knots + s * h) for s in (-2, 2))
    beyond = rates(winding, knots + 6 * h)
    for low, high, higher in zip(before, after, beyond, strict=True):
        # A jump would not shrink with h; what is left is the derivative's change over 4 h.
        slope = np.abs(higher - high).max() / (4 * h)
        assert np.abs(high - low).max() < 4 * h * 3 * slope
    accelerations = [
        (rates(winding, knots + s * 2 * h)[i] - rates(winding, knots + s * h)[i]) / (s * h)
        for i in (0, 1)
        for s in (-1, 1)
    ]
    for i in (0, 2):
        left, right = accelerations[i : i + 2]
        assert np.abs(left - right).max() < 0.02 * np.abs(left).max()


def test_equal_rotation_vectors_make_the_same_path(winding: Path) -> None:
    length = np.linalg.norm(winding.rotations, axis=1, keepdims=True)
    other = winding.rotations * (1 - 2 * np.pi / length)
    t = np.linspace(1, 11, 100)
    np.testing.assert_allclose(Path(winding.times, winding.positions, other).poses(t), winding.poses(t), atol=1e-9)


def test_outside_its_time_a_path_stays_where_it_ends(winding: Path) -> None:
    path = with_stops(winding, np.random.default_rng(1), 2)
    np.testing.assert_array_equal(path.poses(-5.0), path.poses(path.start))
    np.testing.assert_allclose(path.poses(path.end + 5), winding.poses(winding.end), atol=1e-12)
    np.testing.assert_allclose(path.poses(path.end), winding.poses(winding.end), atol=1e-12)


def test_one_knot_is_rest(rng: np.random.Generator) -> None:
    path = Path(np.array([3.0]), rng.normal(size=(1, 3)), rng.normal(size=(1, 3)))
    T = path.poses(np.array([0.0, 3.0, 9.0]))
    assert (T[0] == T).all()
    np.testing.assert_allclose(T[0, :3, :3], rotation_exp(path.rotations[0]), atol=1e-12)


def test_json_gives_the_same_path_to_the_last_bit(winding: Path) -> None:
    path = with_stops(winding, np.random.default_rng(1), 2)
    again = Path.from_json(json.loads(json.dumps(path.to_json())))
    for name in ("times", "positions", "rotations"):
        np.testing.assert_array_equal(getattr(again, name), getattr(path, name))
    assert again.stops == path.stops
    t = np.linspace(path.start, path.end, 50)
    np.testing.assert_array_equal(again.poses(t), path.poses(t))


def test_at_rest_is_the_pose_all_the_time() -> None:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_exp(np.array([0.3, -2.0, 1.0])), [1.0, 2.0, 3.0]
    path = at_rest(pose, 5.0)
    assert (path.start, path.end) == (0.0, 5.0)
    np.testing.assert_allclose(path.poses(np.linspace(0, 5, 11)), np.broadcast_to(pose, (11, 4, 4)), atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_a_stop_is_really_at_rest_and_eased(winding: Path, seed: int) -> None:
    path = with_stops(winding, np.random.default_rng(seed), 3, ease=1.0)
    assert len(path.stops) == 3
    np.testing.assert_allclose(path.end - winding.end, sum(s.hold + s.ease for s in path.stops))
    rested = 0.0
    for stop in path.stops:
        assert 1.0 <= stop.hold <= 3.0
        begin = stop.at + rested + 0.5 * stop.ease
        held = path.poses(np.linspace(begin + 1e-9, begin + stop.hold - 1e-9, 20))
        np.testing.assert_allclose(held, np.broadcast_to(winding.poses(stop.at), held.shape), atol=1e-12)
        for edge in (begin, begin + stop.hold, begin - stop.ease, begin + stop.hold + stop.ease):
            (v0, w0), (v1, w1) = (rates(path, np.array([edge + s])) for s in (-1e-3, 1e-3))
            assert np.abs(v1 - v0).max() < 0.2
            assert np.abs(w1 - w0).max() < 0.2
        rested += stop.hold + stop.ease


def test_stops_keep_the_way_and_never_go_back(winding: Path) -> None:
    path = with_stops(winding, np.random.default_rng(3), 3, ease=0.5)
    clock = path._knot_clock(np.linspace(path.start, path.end, 2000))
    assert (np.diff(clock) >= -1e-12).all()
    np.testing.assert_allclose(clock[[0, -1]], [winding.start, winding.end], atol=1e-12)


def test_wrong_content_is_refused(winding: Path) -> None:
    times, positions, rotations = winding.times, winding.positions, winding.rotations
    with pytest.raises(ValueError, match="increase"):
        Path(times[::-1], positions, rotations)
    with pytest.raises(ValueError, match="positions"):
        Path(times, positions[:-1], rotations)
    with pytest.raises(ValueError, match="rotations of a path must be finite"):
        Path(times, positions, rotations * np.nan)
    with pytest.raises(ValueError, match="too close"):
        Path(times, positions, rotations, (Stop(3.0, 1.0, 1.0), Stop(3.5, 1.0, 1.0)))
    with pytest.raises(ValueError, match="do not fit"):
        with_stops(winding, np.random.default_rng(0), 11)


def test_noise_has_unit_variance_and_keeps_its_bound_and_band(rng: np.random.Generator) -> None:
    t = np.arange(0, 2000, 0.05)
    x = noise(rng, t, 4, 0.5, 1.0)
    np.testing.assert_allclose(x.std(axis=0), 1.0, rtol=0.02)
    assert np.abs(x).max() <= LARGEST_NOISE
    power = np.abs(np.fft.rfft(x, axis=0)) ** 2
    frequency = np.fft.rfftfreq(len(t), 0.05)
    assert power[(frequency > 0.49) & (frequency < 1.01)].sum() > 0.98 * power.sum()


def test_smoothing_to_a_rate_keeps_slow_signals_and_bounds_fast_ones(rng: np.random.Generator) -> None:
    t = np.arange(0, 20, 0.05)
    signals = noise(rng, t, 2, 0.1, 0.5)
    np.testing.assert_array_equal(smooth_to_rate(t, signals, 100.0), signals)
    smooth = smooth_to_rate(t, signals, 1.0)
    rate = np.linalg.norm(np.diff(smooth, axis=0), axis=1) / 0.05
    assert 0.6 < rate.max() <= 1.0


def test_view_rotations_point_where_their_angles_say() -> None:
    yaw, pitch, roll = np.array([0.0, np.pi / 2, 0.0]), np.array([0.0, 0.3, 0.0]), np.array([0.0, 0.0, 0.2])
    R = view_rotations(yaw, pitch, roll)
    np.testing.assert_allclose(R[0], [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-15)  # x right, y down, z ahead
    np.testing.assert_allclose(R[1, :, 2], [0, np.cos(0.3), np.sin(0.3)], atol=1e-15)
    np.testing.assert_allclose(R[2, 2, 0], -np.sin(0.2))  # the right side sinks
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-15)


@pytest.mark.parametrize("duration", [0.3, 7.0, 33.3])
def test_a_padded_clock_is_even_and_its_slice_is_the_duration(duration: float) -> None:
    t, inside = padded_clock(duration)
    np.testing.assert_allclose(np.diff(t), t[1] - t[0], rtol=1e-9)
    assert t[inside][0] == 0.0
    assert t[inside][-1] == duration
    assert t[0] <= -3.0
    assert t[-1] >= duration + 3.0 - 1e-9


@pytest.mark.parametrize("seed", range(5))
def test_a_wandering_curve_fills_its_box_and_is_long_enough(seed: int) -> None:
    half = np.array([2.0, 1.0, 0.1])
    _, curve = wandering_curve(np.random.default_rng(seed), half, 40.0)
    np.testing.assert_allclose(np.abs(curve).max(axis=0), half)
    assert arc_length(curve)[-1] > 40 * 2.0


def test_carried_frames_follow_the_tangents_without_twist() -> None:
    angle = np.linspace(0, 4, 400)
    helix = np.stack([-np.sin(angle), np.cos(angle), np.full(400, 0.7)], axis=-1)
    frames = carried_frames(helix)
    np.testing.assert_allclose(frames[:, :, 2], helix / np.hypot(1, 0.7), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0)
    turn = rotation_log(np.swapaxes(frames[:-1], 1, 2) @ frames[1:])
    assert np.abs(turn[:, 2]).sum() < 0.01 * np.linalg.norm(turn, axis=1).sum()
