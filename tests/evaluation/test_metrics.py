from itertools import accumulate
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core import sync as evo_sync
from evo.core.trajectory import PoseTrajectory3D

from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import rotation_exp, se3_adjoint, se3_exp, se3_inverse
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers.trajectory_files import read_kitti
from sigmaslam_evaluation.metrics.trajectory_errors import (
    absolute_trajectory_error,
    associate,
    is_regular,
    kitti_errors,
    pose_nees,
    relative_pose_error,
    synchronise,
)
from sigmaslam_evaluation.metrics.truth_covariance import TruthErrors, truth_covariance


@pytest.fixture(scope="module")
def truth(real_data: Path) -> Trajectory:
    """Real motion of a car, 1201 poses, 920 m."""
    return read_kitti(real_data / "kitti_gt_trajectories" / "10.txt")


def _drift(truth: Trajectory, seed: int = 0, translation: float = 0.02, rotation: float = 1e-3) -> Trajectory:
    """The truth with noise on every motion, in another world frame."""
    generator = np.random.default_rng(seed)
    motions = se3_inverse(truth.poses[:-1]) @ truth.poses[1:]
    scale = np.repeat([translation, rotation], 3)
    motions = motions @ se3_exp(scale * generator.normal(size=(len(motions), 6)))
    poses = [se3_exp(np.array([3.0, -2.0, 1.0, 0.4, -0.3, 0.8]))]
    for motion in motions:
        poses.append(poses[-1] @ motion)
    return Trajectory(truth.timestamps, np.array(poses))


def _evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(trajectory.poses), timestamps=trajectory.timestamps)


def _evo_statistics(metric, truth: Trajectory, estimate: Trajectory) -> dict[str, float]:
    metric.process_data((_evo(truth), _evo(estimate)))
    return metric.get_all_statistics()


@pytest.mark.parametrize(("alignment", "method"), [("se3", "align"), ("origin", "align_origin")])
def test_ate_equals_evo(truth, alignment, method):
    estimate = _drift(truth)
    reference = _evo(estimate)
    getattr(reference, method)(_evo(truth))
    ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    ape.process_data((_evo(truth), reference))
    angle = evo_metrics.APE(evo_metrics.PoseRelation.rotation_angle_deg)
    angle.process_data((_evo(truth), reference))
    expected = ape.get_all_statistics()
    ours = absolute_trajectory_error(estimate, truth, alignment)
    assert ours.rmse > 1
    assert ours.rmse == pytest.approx(expected["rmse"], rel=1e-9)
    assert ours.mean == pytest.approx(expected["mean"], rel=1e-9)
    assert ours.median == pytest.approx(expected["median"], rel=1e-9)
    assert ours.maximum == pytest.approx(expected["max"], rel=1e-9)
    assert ours.rotation_rmse_deg == pytest.approx(angle.get_all_statistics()["rmse"], rel=1e-9)
    assert ours.count == len(truth)


def test_rpe_equals_evo(truth):
    estimate = _drift(truth)
    ours = relative_pose_error(estimate, truth)
    relations = evo_metrics.PoseRelation
    for relation, rmse, median, steps in [
        (relations.translation_part, ours.translation_rmse, ours.translation_median, ours.translations),
        (relations.rotation_angle_deg, ours.rotation_rmse_deg, ours.rotation_median_deg, ours.rotations_deg),
    ]:
        rpe = evo_metrics.RPE(relation, delta=1, delta_unit=evo_metrics.Unit.frames, all_pairs=True)
        expected = _evo_statistics(rpe, truth, estimate)
        np.testing.assert_allclose(steps, rpe.error, rtol=1e-7)
        assert rmse == pytest.approx(expected["rmse"], rel=1e-9)
        assert median == pytest.approx(expected["median"], rel=1e-9)


def test_the_forward_error_is_the_part_along_the_true_step():
    generator = np.random.default_rng(3)
    steps = se3_exp(generator.normal(0.0, 0.3, (50, 6)))
    steps[7, :3, 3] = 0.0  # a turn on the spot has no direction
    along, across = generator.normal(0.0, 0.1, (2, 50))
    direction = steps[:, :3, 3] / np.maximum(np.linalg.norm(steps[:, :3, 3], axis=1, keepdims=True), 1e-300)
    side = np.cross(direction, generator.normal(0.0, 1.0, (50, 3)))
    wrong = steps.copy()
    wrong[:, :3, 3] += along[:, None] * direction + across[:, None] * side
    poses = [np.stack(list(accumulate([np.eye(4), *each], np.matmul))) for each in (steps, wrong)]
    truth, estimate = (Trajectory(np.arange(51.0), each) for each in poses)
    found = relative_pose_error(estimate, truth)
    along[7] = 0.0
    np.testing.assert_allclose(found.forward, along, atol=1e-12)
    np.testing.assert_allclose(found.lengths, np.linalg.norm(steps[:, :3, 3], axis=1), atol=1e-12)


def test_missing_frames_and_jittered_times_equal_evo(truth):
    generator = np.random.default_rng(5)
    kept = np.sort(generator.choice(len(truth), 900, replace=False))
    estimate = _drift(truth).subset(kept)
    estimate = Trajectory(estimate.timestamps + generator.uniform(-0.009, 0.009, 900), estimate.poses)
    reference_truth, reference = evo_sync.associate_trajectories(_evo(truth), _evo(estimate), max_diff=0.02)
    reference.align(reference_truth)
    ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    ape.process_data((reference_truth, reference))
    ours = absolute_trajectory_error(estimate, truth)
    assert ours.count == 900
    assert ours.rmse == pytest.approx(ape.get_all_statistics()["rmse"], rel=1e-9)


def _devkit(estimate: np.ndarray, truth: np.ndarray, step: int) -> dict[float, list[tuple[float, float]]]:
    """evaluate_odometry.cpp, line by line: (rotation error, translation error) a metre, of each segment."""
    distances = [0.0]
    for i in range(1, len(truth)):
        dx, dy, dz = (truth[i][k, 3] - truth[i - 1][k, 3] for k in range(3))
        distances.append(distances[-1] + np.sqrt(dx * dx + dy * dy + dz * dz))
    errors: dict[float, list[tuple[float, float]]] = {}
    for first in range(0, len(truth), step):
        for length in range(100, 900, 100):
            last = -1
            for i in range(first, len(distances)):
                if distances[i] > distances[first] + length:
                    last = i
                    break
            if last == -1:
                continue
            delta_truth = np.linalg.inv(truth[first]) @ truth[last]
            delta_estimate = np.linalg.inv(estimate[first]) @ estimate[last]
            error = np.linalg.inv(delta_estimate) @ delta_truth
            d = 0.5 * (error[0, 0] + error[1, 1] + error[2, 2] - 1.0)
            rotation = np.arccos(max(min(d, 1.0), -1.0))
            translation = np.sqrt(error[0, 3] ** 2 + error[1, 3] ** 2 + error[2, 3] ** 2)
            errors.setdefault(length, []).append((rotation / length, translation / length))
    return errors


@pytest.mark.parametrize("step", [None, 7])
def test_kitti_errors_equal_the_devkit(truth, step):
    estimate = _drift(truth)
    expected = _devkit(estimate.poses, truth.poses, step or 10)
    ours = kitti_errors(estimate, truth, step=step)
    assert ours.lengths.tolist() == list(expected)
    assert ours.counts.tolist() == [len(errors) for errors in expected.values()]
    means = np.array([np.mean(errors, axis=0) for errors in expected.values()])
    np.testing.assert_allclose(ours.translation_percent, 100 * means[:, 1], rtol=1e-9)
    np.testing.assert_allclose(ours.rotation_deg_per_100m, 100 * np.degrees(means[:, 0]), rtol=1e-8)
    rotation, translation = np.mean(np.concatenate(list(expected.values())), axis=0)
    assert ours.mean_translation_percent == pytest.approx(100 * translation, rel=1e-9)
    assert ours.mean_rotation_deg_per_100m == pytest.approx(100 * np.degrees(rotation), rel=1e-8)


def _straight(length: float, count: int) -> Trajectory:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = np.linspace(0, length, count)
    return Trajectory(0.1 * np.arange(count), poses)


def test_one_percent_of_scale_is_one_percent_of_t_rel():
    truth = _straight(1000, 10001)
    poses = truth.poses.copy()
    poses[:, :3, 3] *= 1.01
    errors = kitti_errors(Trajectory(truth.timestamps, poses), truth)
    # A segment ends at the first frame past its length, here up to 0.1 m late.
    np.testing.assert_allclose(errors.translation_percent, 1.0, atol=1.1e-3)
    np.testing.assert_allclose(errors.rotation_deg_per_100m, 0.0, atol=1e-12)
    assert errors.mean_translation_percent == pytest.approx(1.0, abs=1.1e-3)


def test_constant_turn_rate_error_is_the_r_rel():
    truth = _straight(300, 3001)
    turns = rotation_exp(np.radians(0.02) * truth.positions[:, 2:] * np.array([0.0, 1.0, 0.0]))
    poses = truth.poses.copy()
    poses[:, :3, :3] = turns
    errors = kitti_errors(Trajectory(truth.timestamps, poses), truth)
    assert errors.mean_rotation_deg_per_100m == pytest.approx(2.0, abs=3e-3)


@pytest.mark.parametrize(
    ("length", "expected"), [(35.0, [10, 20, 30]), (99.0, [10, 20, 30, 40, 50]), (250.0, [100, 200])]
)
def test_segment_lengths_follow_the_path(length, expected):
    truth = _straight(length, 500)
    assert kitti_errors(truth, truth).lengths.tolist() == expected
    assert kitti_errors(truth, truth, lengths=(5, 1e4)).lengths.tolist() == [5]


def test_no_segment_gives_nan_not_zero():
    errors = kitti_errors(_straight(1, 20), _straight(1, 20))
    assert len(errors.lengths) == 0
    assert np.isnan(errors.mean_translation_percent)


def test_association_is_nearest_and_one_to_one():
    truth = _straight(1, 5)
    estimate = Trajectory(np.array([-0.5, 0.005, 0.012, 0.095, 0.155, 0.31]), np.tile(np.eye(4), (6, 1, 1)))
    estimate_index, truth_index = associate(estimate, truth)
    assert estimate_index.tolist() == [1, 3, 5]
    assert truth_index.tolist() == [0, 1, 3]


def test_association_equals_a_loop(truth):
    generator = np.random.default_rng(2)
    stamps = np.sort(generator.uniform(-1, 122, 300))
    estimate = Trajectory(stamps, np.tile(np.eye(4), (300, 1, 1)))
    best: dict[int, tuple[float, int]] = {}
    for i, stamp in enumerate(stamps):
        j = int(np.argmin(np.abs(truth.timestamps - stamp)))
        difference = abs(truth.timestamps[j] - stamp)
        if difference <= 0.03 and (j not in best or difference < best[j][0]):
            best[j] = (difference, i)
    estimate_index, truth_index = associate(estimate, truth, 0.03)
    assert truth_index.tolist() == sorted(best)
    assert estimate_index.tolist() == [best[j][1] for j in sorted(best)]


def test_clocks_that_do_not_meet_are_explained():
    truth = _straight(1, 5)
    estimate = Trajectory(truth.timestamps + 1.4e9, truth.poses)
    with pytest.raises(
        InputError, match=r"5 poses from 1400000000\.000.*5 poses from 0\.000 to 0\.400.*same timestamps"
    ):
        associate(estimate, truth)
    with pytest.raises(InputError, match=r"4 poses.*times\.txt"):
        associate(estimate.subset(slice(1, None)), truth)
    with pytest.raises(InputError, match="no poses"):
        associate(estimate.subset(slice(0, 0)), truth)


def test_too_short_for_a_step_is_explained():
    with pytest.raises(InputError, match="needs two"):
        relative_pose_error(_straight(1, 5).subset([0]), _straight(1, 5))


def test_a_trajectory_is_synchronised_with_itself():
    truth = _straight(1, 5)
    assert len(synchronise(truth, truth)[0]) == 5


def _runs(scale: float, runs: int = 40, count: int = 40) -> np.ndarray:
    """Mean NEES of runs whose motions have noise of known covariance, times `scale` in the claim."""
    generator = np.random.default_rng(7)
    motion = se3_exp(np.array([0.02, 0.0, 0.5, 0.0, 0.03, 0.01]))
    true = [np.eye(4)]
    for _ in range(count - 1):
        true.append(true[-1] @ motion)
    Q = np.diag(np.array([0.01, 0.02, 0.03, 0.001, 0.002, 0.001]) ** 2)
    adjoint = se3_adjoint(se3_inverse(motion))
    covariance = np.zeros((count, 6, 6))
    for k in range(1, count):
        covariance[k] = adjoint @ covariance[k - 1] @ adjoint.T + Q
    truth = Trajectory(0.1 * np.arange(count), se3_exp(np.array([5.0, 1, 2, 1.0, -0.4, 2.0])) @ np.array(true))
    values = []
    for _ in range(runs):
        poses = [np.eye(4)]
        for _ in range(count - 1):
            poses.append(poses[-1] @ motion @ se3_exp(generator.multivariate_normal(np.zeros(6), Q)))
        nees = pose_nees(Trajectory(truth.timestamps, np.array(poses)), truth, scale * covariance)
        assert len(nees.per_frame) == count - 1
        values.append([nees.mean, nees.mean_translation, nees.mean_rotation])
    return np.mean(values, axis=0)


def test_nees_of_a_right_covariance_is_one():
    # Frames of a run are correlated: 40 runs of about 4 independent 6-dof values each.
    np.testing.assert_allclose(_runs(1.0), 1.0, atol=0.15)


def test_nees_of_a_covariance_four_times_too_small_is_four():
    np.testing.assert_allclose(_runs(0.25), 4.0, atol=0.6)


def test_nees_is_in_the_body_frame():
    truth = _straight(1, 2)
    poses = truth.poses.copy()
    poses[1] = poses[1] @ se3_exp(np.array([0, 0, 0.3, 0, 0, 0]))
    turn = np.eye(4)
    turn[:3, :3] = rotation_exp(np.array([0, np.pi / 2, 0]))
    covariance = np.tile(np.diag([1e-4, 1e-4, 0.09, 1e-4, 1e-4, 1e-4]), (2, 1, 1))
    turned = Trajectory(truth.timestamps, turn @ truth.poses)
    nees = pose_nees(Trajectory(truth.timestamps, poses), turned, covariance)
    assert nees.mean == pytest.approx(1 / 6)
    assert nees.mean_translation == pytest.approx(1 / 3)
    assert nees.mean_rotation == pytest.approx(0.0, abs=1e-20)


@pytest.mark.long
def test_errors_of_the_truth_are_part_of_the_nees_where_they_are_known():
    rng = np.random.default_rng(0)
    of_truth, covariance = truth_covariance(0.05, 0.5), np.diag([1e-2, 1e-2, 4e-2, 1e-5, 4e-5, 1e-5])
    values = []
    for _ in range(400):
        exact = se3_exp(np.stack([np.zeros(6), np.array([5.0, 1.0, 9.0, 0.3, -0.5, 0.1])]))
        estimated = exact @ se3_exp(np.stack([np.zeros(6), rng.multivariate_normal(np.zeros(6), covariance)]))
        measured = exact @ se3_exp(rng.multivariate_normal(np.zeros(6), of_truth, 2))
        pair = Trajectory(np.arange(2.0), estimated), Trajectory(np.arange(2.0), measured), np.stack([covariance] * 2)
        values.append([pose_nees(*pair, TruthErrors(of_truth)).mean, pose_nees(*pair).mean])
    with_truth, without = np.mean(values, axis=0)
    assert with_truth == pytest.approx(1.0, abs=0.1)  # four standard errors of chi-square with 6 dof are 0.12
    assert without > 2.0


def test_singular_covariances_are_left_out_whatever_the_units():
    matrix = np.diag([1e-9, 1e6, 1.0])
    rank_two = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    batch = np.stack([matrix, rank_two, np.zeros((3, 3)), np.full((3, 3), np.nan), -np.eye(3)])
    assert is_regular(batch).tolist() == [True, False, False, False, False]


def test_nees_without_a_usable_frame_is_nan():
    nees = pose_nees(_straight(1, 5), _straight(1, 5), np.zeros((5, 6, 6)))
    assert np.isnan(nees.mean)
    assert len(nees.per_frame) == 0
    with pytest.raises(ValueError, match=r"\(5, 6, 6\)"):
        pose_nees(_straight(1, 5), _straight(1, 5), np.zeros((4, 6, 6)))
