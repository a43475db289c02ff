"""Localisation and mapping at once: how a landmark enters the state, and whether the covariance is to be believed."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import chi2

from sigmaslam_filters import ExtendedKalmanFilter, Gaussian, UnscentedKalmanFilter, several
from sigmaslam_filters.core.noise_covariance import Diagonal
from sigmaslam_localisation.mapping_robot import ROBOT_SIZE, MappingRobot
from sigmaslam_localisation.robots import in_world
from sigmaslam_localisation.wheeled_robot import BODY, WheeledRobot

pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.timeout(300)]

NOISE = np.array([0.1, 0.02])


def seen_place(pose, constants, lever, value):
    """The inverse of the sensor, by homogeneous matrices."""
    offset, scale = constants[5], constants[6]
    in_sensor = value[0] / (1 + scale) * np.array([np.cos(value[1] - offset), np.sin(value[1] - offset)])
    turn = np.array([[np.cos(pose[2]), -np.sin(pose[2])], [np.sin(pose[2]), np.cos(pose[2])]])
    return pose[:2] + turn @ (in_sensor + [lever, 0.0] + constants[7:9])


def correlated_belief(generator, mapping, batch=()):
    size = mapping.space.tangent_size
    root = 0.05 * generator.normal(size=(*batch, size, size)) / np.sqrt(size)
    mean = 0.3 * generator.normal(size=(*batch, size))
    return Gaussian(torch.from_numpy(mean), torch.from_numpy(root @ np.swapaxes(root, -1, -2)))


@pytest.mark.long
def test_a_landmark_enters_with_its_cross_covariance():
    """Against derivatives by central differences of an independent inverse of the sensor."""
    mapping = MappingRobot("range-bearing", 0.2, landmarks=3)
    belief = correlated_belief(np.random.default_rng(0), mapping)
    value = np.array([2.0, 0.7])
    variance = torch.from_numpy(NOISE**2)
    admitted = mapping.admit(
        ExtendedKalmanFilter(mapping.space),
        belief,
        torch.from_numpy(value)[None],
        variance[None],
        torch.tensor([1]),
        torch.tensor([True]),
    )
    mean = belief.mean.numpy()
    covariance = in_world(mapping.space, mean, belief.covariance.numpy())

    def place(change, noise):
        robot = (mean + change)[:ROBOT_SIZE]
        return seen_place(robot[:3], robot[3:], 0.2, value + noise)

    size, h = len(mean), 1e-6
    by_state = np.stack([(place(e, 0.0) - place(-e, 0.0)) / (2 * h) for e in h * np.eye(size)], axis=1)
    still = np.zeros(size)
    by_noise = np.stack([(place(still, e) - place(still, -e)) / (2 * h) for e in h * np.eye(2)], axis=1)
    # Rows of the new landmark are functions of the state; all others are what they were.
    slot = slice(ROBOT_SIZE + 2, ROBOT_SIZE + 4)
    change = np.eye(size)
    change[slot] = by_state
    expected = change @ covariance @ change.T
    expected[slot, slot] += by_noise @ np.diag(NOISE**2) @ by_noise.T
    np.testing.assert_allclose(admitted.mean[slot], place(still, 0.0), atol=1e-12)
    found = in_world(mapping.space, admitted.mean.numpy(), admitted.covariance.numpy())
    np.testing.assert_allclose(found, expected, atol=1e-9)
    others = np.setdiff1d(np.arange(size), np.arange(size)[slot])
    np.testing.assert_allclose(admitted.mean[others], mean[others], atol=1e-12)


def test_what_no_sighting_shows_is_the_same_tangent_at_all_estimates():
    """Of a world that is shifted and turned as a whole, and of one whose metre is another."""
    generator = np.random.default_rng(4)
    mapping = MappingRobot("cartesian", 0.2, landmarks=2, origin=(3.0, -1.0))
    point, number = torch.from_numpy(0.3 * generator.normal(size=(20, 16))), torch.ones(20, 1)
    tangent = torch.zeros(16, dtype=torch.float64)
    for part in (slice(0, 2), slice(12, 14), slice(14, 16)):
        tangent[part] = torch.tensor([5.0, -3.0])
    tangent[2], tangent[9] = 1.2, 0.1
    moved, see = mapping.space.retract(point, tangent), mapping.measurement().function
    assert torch.dist(moved, point) > 10.0
    np.testing.assert_allclose(see(moved, number), see(point, number), atol=1e-12)
    np.testing.assert_allclose(mapping.space.local(point, moved), tangent.expand(20, 16), atol=1e-12)


@pytest.mark.parametrize("kind", ["range-bearing", "cartesian"])
def test_a_place_is_seen_where_it_was_seen(kind):
    generator = np.random.default_rng(1)
    robot = MappingRobot(kind, 0.2, origin=(1.0, -2.0))
    state = torch.from_numpy(0.3 * generator.normal(size=(20, ROBOT_SIZE)))
    value = torch.from_numpy(np.column_stack([generator.uniform(1, 4, 20), generator.uniform(-1.5, 1.5, 20)]))
    np.testing.assert_allclose(
        WheeledRobot(kind, 0.2).measurement().function(state, robot.place(state, value)), value, atol=1e-12
    )


def test_a_robot_that_sees_nothing_new_keeps_its_belief():
    mapping = MappingRobot("range-bearing", 0.0, landmarks=2)
    belief = correlated_belief(np.random.default_rng(2), mapping, (2,))
    value = torch.tensor([[[2.0, 0.5]], [[np.nan, np.nan]]], dtype=torch.float64)
    admitted = mapping.admit(
        UnscentedKalmanFilter(mapping.space),
        belief,
        value,
        torch.full_like(value, 0.01),
        torch.tensor([[0], [0]]),
        torch.tensor([[True], [False]]),
    )
    np.testing.assert_allclose(admitted.mean[1], belief.mean[1], atol=1e-12)
    np.testing.assert_allclose(admitted.covariance[1], belief.covariance[1], atol=1e-12)
    assert not torch.equal(admitted.mean[0], belief.mean[0])


@pytest.mark.long
@pytest.mark.parametrize("make", [ExtendedKalmanFilter, UnscentedKalmanFilter])
def test_robot_and_map_are_as_uncertain_as_they_are_wrong(make):
    """Fifty robots drawn from their own models drive a loop: NEES of pose and map within 99.9 % of chi-square."""
    of_pose, of_map = map_while_driving(make, runs=50, steps=240, seed=3)
    assert_chi_square(of_pose, 3)
    assert_chi_square(of_map, 10)


def map_while_driving(make, runs, steps, seed):
    """NEES (runs,) of pose and of five landmarks at the end, of robots that are drawn from their own models."""
    duration, generator = 0.5, np.random.default_rng(seed)
    mapping = MappingRobot("range-bearing", 0.1, landmarks=5, origin=(2.0, -0.5))
    places = np.array([[0.0, 0.0], [3.0, -1.0], [4.0, 3.0], [0.0, 4.0], [2.0, 1.5]])
    start = torch.tensor([[2.0, -0.5, 0.0]], dtype=torch.float64).expand(runs, 3)
    alone = mapping.prior(start)
    bayes, belief = make(mapping.space), mapping.enter(alone)
    deviations = np.sqrt(alone.covariance[0].diagonal().numpy())
    pose = BODY.retract(start, torch.from_numpy(deviations[:3] * generator.normal(size=(runs, 3)))).numpy()
    constants = deviations[3:] * generator.normal(size=(runs, ROBOT_SIZE - 3))
    path = torch.tensor([[0.15, 0.11]], dtype=torch.float64).expand(runs, 2)
    time = torch.full((runs,), duration, dtype=torch.float64)
    number = torch.arange(5).expand(runs, 5)
    see = several(mapping.measurement(), 5)
    see = replace(see, noise=Diagonal(torch.from_numpy(np.tile(NOISE**2, 5))))
    known = np.zeros((runs, 5), bool)
    for _ in range(steps):
        pose = drive_truly(mapping, pose, constants, path.numpy(), duration, generator)
        value = sense(pose, constants, places) + NOISE * generator.normal(size=(runs, 5, 2))
        # A field of view: half of the plane.
        visible = np.abs(np.arctan2(np.sin(value[..., 1]), np.cos(value[..., 1]))) < np.pi / 2
        belief = bayes.predict(belief, mapping.motion(path, time), path, time[:, None]).belief
        used = torch.from_numpy(np.where((visible & known)[..., None], value, np.nan)).flatten(-2)
        belief = bayes.update(belief, see, used, number[..., None]).belief
        new = torch.from_numpy(visible & ~known)
        noise = torch.from_numpy(NOISE**2).expand(runs, 5, 2)
        belief = mapping.admit(bayes, belief, torch.from_numpy(value), noise, number, new)
        known |= visible
    assert known.all()
    off = np.hstack([pose, constants, np.tile(places.ravel(), (runs, 1))]) - belief.mean.numpy()
    off[:, 2] = np.arctan2(np.sin(off[:, 2]), np.cos(off[:, 2]))
    covariance = in_world(mapping.space, belief.mean.numpy(), belief.covariance.numpy())
    of_pose, of_map = slice(3), slice(ROBOT_SIZE, None)
    return tuple(nees(off[:, part], covariance[:, part, part]) for part in (of_pose, of_map))


def drive_truly(mapping, pose, constants, path, duration, generator):
    """Arcs, of a robot with constants (B, 9) as `wheeled_robot` lists them."""
    noise = mapping.noise
    distance = path[:, 0] * (1 + constants[:, 0]) + duration * constants[:, 2]
    turn = path[:, 1] * (1 + constants[:, 1]) + duration * constants[:, 3]
    for_drive, for_turn = generator.normal(size=(2, len(pose)))
    distance = distance + np.sqrt(noise.drive[0] ** 2 * duration + noise.drive[1] ** 2 * path[:, 0]) * for_drive
    turn = turn + np.sqrt(noise.turn[0] ** 2 * duration + noise.turn[1] ** 2 * path[:, 1]) * for_turn
    # The chord of an arc is half a turn off its start.
    chord = distance * np.sinc(turn / (2 * np.pi))
    course = pose[:, 2] + constants[:, 4] + turn / 2
    step = np.column_stack([chord * np.cos(course), chord * np.sin(course), turn])
    return pose + step


def sense(pose, constants, places):
    offset = places - pose[:, None, :2]
    bearing = np.arctan2(offset[..., 1], offset[..., 0]) - pose[:, None, 2]
    ahead = np.hypot(*np.moveaxis(offset, -1, 0)) * np.cos(bearing) - 0.1 - constants[:, 7:8]
    left = np.hypot(*np.moveaxis(offset, -1, 0)) * np.sin(bearing) - constants[:, 8:9]
    distance, bearing = np.hypot(ahead, left), np.arctan2(left, ahead) + constants[:, 5:6]
    return np.stack([distance * (1 + constants[:, 6:7]), bearing], axis=-1)


def nees(error, covariance):
    return np.einsum("bi,bi->b", error, np.linalg.solve(covariance, error[..., None])[..., 0])


def assert_chi_square(values, dof):
    total = len(values) * dof
    low, high = chi2.ppf([0.0005, 0.9995], total)
    assert low < values.sum() < high, f"mean NEES {values.mean():.2f} of {dof}"
