"""Each convention of truth files, put into a real truth, is named with the options that undo it; none is else."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import matrix_to_quaternion, rotation_exp, se3_exp, se3_inverse
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers.trajectory_files import read_kitti, read_trajectory, write_kitti, write_tum
from sigmaslam_evaluation.evaluation_summary import format_evaluation
from sigmaslam_evaluation.metrics.trajectory_errors import associate
from sigmaslam_evaluation.run_evaluation import evaluate_run
from sigmaslam_evaluation.truth_conventions import (
    TIME_UNITS,
    TruthConvention,
    describe_clock_offset,
    describe_lack_of_rotation,
    find_truth,
    interpolate_truth,
)
from tests.support.commands import assert_refused, run_here

KITTI = ("04", "05", "07", "10")


@pytest.fixture(params=["demo", "drive", *(pytest.param(name, marks=pytest.mark.long) for name in KITTI)])
def truth(request: pytest.FixtureRequest, demo_sequence: Path) -> Trajectory:
    """The rendered demo, a real drive, and real roads: 04 is straight."""
    if request.param == "demo":
        return read_kitti(demo_sequence / "poses.txt")
    data = request.getfixturevalue("real_data")
    if request.param == "drive":
        return read_trajectory(data / "kitti_raw_0926_0039_a" / "poses.txt")
    return read_kitti(data / "kitti_gt_trajectories" / f"{request.param}.txt").subset(slice(0, 400))


def write_estimate(path: Path, truth: Trajectory) -> None:
    """The truth with a drift of 1 % and a tenth of a degree a metre, at most, in a world of its own."""
    generator = np.random.default_rng(3)
    motions = se3_inverse(truth.poses[:-1]) @ truth.poses[1:]
    steps = np.linalg.norm(motions[:, :3, 3], axis=1, keepdims=True)
    errors = generator.normal(size=(len(motions), 6)) * steps * np.repeat([0.01, 0.002], 3)
    poses = [np.eye(4)]
    for motion, error in zip(motions, errors, strict=True):
        poses.append(poses[-1] @ motion @ se3_exp(error))
    write_tum(path, Trajectory(truth.timestamps, np.array(poses)))


def write_truth(path: Path, truth: Trajectory, convention: TruthConvention, seconds: float = 1.0) -> None:
    """A TUM file in this convention, by its definition; `seconds` is the unit of its times."""
    poses = truth.poses.copy()
    if convention.frame == "body":
        # The body's x, y, z axes in the camera: ahead, left, up.
        axes = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]).T
        poses[:, :3, :3] = poses[:, :3, :3] @ axes
    if convention.inverse:
        poses = np.linalg.inv(poses)
    poses[:, :3, 3] *= {"m": 1, "cm": 100, "mm": 1000}[convention.unit]
    x, y, z, w = matrix_to_quaternion(poses[:, :3, :3]).T
    columns = (w, x, y, z) if convention.quaternion == "wxyz" else (x, y, z, w)
    np.savetxt(path, np.column_stack([truth.timestamps / seconds, poses[:, :3, 3], *columns]), fmt="%.9f")


CONVENTIONS = [
    TruthConvention(*values)
    for values in itertools.product(("camera", "body"), (False, True), ("xyzw", "wxyz"), ("m", "mm"))
]
CONVENTIONS += [TruthConvention(unit="cm"), TruthConvention("body", True, "wxyz", "cm")]


@pytest.mark.parametrize("convention", CONVENTIONS[1:], ids=TruthConvention.describe)
def test_a_convention_is_named_and_its_options_undo_it(truth: Trajectory, tmp_path: Path, convention: TruthConvention):
    across = np.linalg.svd(truth.positions - truth.positions.mean(axis=0), compute_uv=False)
    if convention.inverse and convention.quaternion == "wxyz" and across[1] < 0.005 * across[0]:
        pytest.skip("a road straight to 0.2 %: the two turn it to and fro, and the drift is larger than what is left")
    write_estimate(tmp_path / "estimate.tum", truth)
    write_tum(tmp_path / "plain.tum", truth)
    write_truth(tmp_path / "truth.tum", truth, convention)
    right = evaluate_run(tmp_path / "estimate.tum", tmp_path / "plain.tum", plot=False)
    wrong = evaluate_run(tmp_path / "estimate.tum", tmp_path / "truth.tum", plot=False)
    assert wrong.truth_hint == convention.describe()
    assert f"The truth looks like {wrong.truth_hint}" in format_evaluation(wrong)
    assert wrong.ate_origin.rmse > 5 * right.ate_origin.rmse  # said, not applied
    mended = evaluate_run(tmp_path / "estimate.tum", tmp_path / "truth.tum", plot=False, truth_convention=convention)
    assert mended.truth_hint is None
    assert mended.ate_origin.rmse == pytest.approx(right.ate_origin.rmse, rel=1e-4, abs=1e-6)
    assert mended.ate_origin.rotation_rmse_deg == pytest.approx(right.ate_origin.rotation_rmse_deg, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("convention", [TruthConvention("body"), TruthConvention(unit="mm")])
def test_options_that_a_usual_truth_does_not_need_are_named(
    truth: Trajectory, tmp_path: Path, convention: TruthConvention
):
    write_estimate(tmp_path / "estimate.tum", truth)
    write_tum(tmp_path / "truth.tum", truth)
    wrong = evaluate_run(tmp_path / "estimate.tum", tmp_path / "truth.tum", plot=False, truth_convention=convention)
    assert wrong.truth_hint == TruthConvention().describe()
    assert "give no option" in wrong.truth_hint


@pytest.mark.parametrize("scale", [3.28, 30.0], ids=["feet", "no unit"])
def test_no_unit_is_named_that_leaves_the_path_too_long_or_short(demo_sequence: Path, tmp_path: Path, scale: float):
    truth = read_kitti(demo_sequence / "poses.txt")
    write_estimate(tmp_path / "estimate.tum", truth)
    truth.poses[:, :3, 3] *= scale
    write_tum(tmp_path / "truth.tum", truth)
    assert evaluate_run(tmp_path / "estimate.tum", tmp_path / "truth.tum", plot=False).truth_hint is None


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("both", [True, False], ids=["with rotations", "positions alone"])
def test_a_mirrored_truth_is_named(tmp_path: Path, axis: int, both: bool):
    angle = np.linspace(0.0, 3.0, 200)
    turned = np.column_stack([0.3 * np.sin(2 * angle), angle, 0.2 * np.cos(3 * angle)])
    poses = se3_exp(np.column_stack([np.zeros((200, 3)), turned]))
    poses[:, :3, 3] = np.column_stack([5 * np.sin(angle), 2 * np.sin(2 * angle), 5 - 5 * np.cos(angle)])
    truth = Trajectory(0.1 * np.arange(200), poses)
    write_estimate(tmp_path / "estimate.tum", truth)
    sign = np.ones(3)
    sign[axis] = -1.0
    mirrored = poses.copy()
    mirrored[:, :3, 3] *= sign
    if both:
        mirrored[:, :3, :3] = np.diag(sign) @ mirrored[:, :3, :3] @ np.diag(sign)
    write_tum(tmp_path / "truth.tum", Trajectory(truth.timestamps, mirrored))
    hint = evaluate_run(tmp_path / "estimate.tum", tmp_path / "truth.tum", plot=False).truth_hint
    assert hint is not None
    assert hint.startswith(f"a mirror image: change the sign of {'xyz'[axis]} in the file")
    assert hint.endswith("rotations") == both


def test_the_right_truth_gives_no_hint(truth: Trajectory, tmp_path: Path):
    write_estimate(tmp_path / "estimate.tum", truth)
    for name, write in (("truth.tum", write_tum), ("truth.txt", write_kitti)):
        write(tmp_path / name, truth)
        evaluation = evaluate_run(tmp_path / "estimate.tum", tmp_path / name, plot=False)
        assert evaluation.truth_hint is None
        assert "looks like" not in format_evaluation(evaluation)


@pytest.mark.parametrize("seed", range(5))
def test_an_estimate_of_another_path_gives_no_hint(truth: Trajectory, tmp_path: Path, seed: int):
    """A bad estimate is no reason to doubt the truth."""
    generator = np.random.default_rng(seed)
    steps = np.median(np.linalg.norm(np.diff(truth.positions, axis=0), axis=1))
    twists = generator.normal(size=(len(truth) - 1, 6)) * np.repeat([steps, 0.05], 3)
    poses = list(itertools.accumulate(se3_exp(twists), np.matmul, initial=np.eye(4)))
    write_tum(tmp_path / "estimate.tum", Trajectory(truth.timestamps, np.array(poses)))
    write_tum(tmp_path / "truth.tum", truth)
    assert evaluate_run(tmp_path / "estimate.tum", tmp_path / "truth.tum", plot=False).truth_hint is None


@pytest.mark.parametrize("origin", [0.0, 1.5e9])
@pytest.mark.parametrize("unit", TIME_UNITS)
def test_the_unit_of_times_is_found_and_told(demo_sequence: Path, tmp_path: Path, unit: str, origin: float):
    truth = read_kitti(demo_sequence / "poses.txt")
    truth = Trajectory(truth.timestamps + origin, truth.poses)
    write_estimate(tmp_path / "estimate.tum", truth)
    write_truth(tmp_path / "truth.tum", truth, TruthConvention(), TIME_UNITS[unit])
    evaluation = evaluate_run(tmp_path / "estimate.tum", tmp_path / "truth.tum", plot=False)
    assert evaluation.association == f"time, that of the truth in {unit}"
    assert evaluation.matched == len(truth)
    write_tum(tmp_path / "plain.tum", truth)
    plain = evaluate_run(tmp_path / "estimate.tum", tmp_path / "plain.tum", plot=False)
    assert plain.association == "time"
    assert evaluation.ate.rmse == pytest.approx(plain.ate.rmse, rel=1e-4)


def test_a_standing_camera_gives_no_hint(real_data: Path, tmp_path: Path):
    truth = real_data / "euroc_v1_01_static" / "groundtruth.csv"
    still = read_trajectory(truth)
    noise = se3_exp(1e-3 * np.random.default_rng(0).normal(size=(len(still), 6)))
    write_tum(tmp_path / "estimate.tum", Trajectory(still.timestamps, noise))
    assert evaluate_run(tmp_path / "estimate.tum", truth, plot=False).truth_hint is None


def test_the_order_of_quaternions_is_refused_where_there_are_none(demo_sequence: Path, tmp_path: Path):
    write_estimate(tmp_path / "estimate.tum", read_kitti(demo_sequence / "poses.txt"))
    with pytest.raises(InputError, match=r"poses\.txt: the order of quaternions can be chosen for TUM files alone"):
        evaluate_run(
            tmp_path / "estimate.tum",
            demo_sequence / "poses.txt",
            plot=False,
            truth_convention=TruthConvention(quaternion="wxyz"),
        )


@pytest.mark.long
def test_the_command_says_and_takes_the_options(demo_sequence: Path, tmp_path: Path):
    truth = read_kitti(demo_sequence / "poses.txt")
    write_estimate(tmp_path / "estimate.tum", truth)
    convention = TruthConvention("body", True, "wxyz", "mm")
    write_truth(tmp_path / "truth.tum", truth, convention)
    command = ("evaluate", tmp_path / "estimate.tum", "--truth", tmp_path / "truth.tum")
    said = run_here(*command)
    assert said.returncode == 0, said.stderr
    line = next(line for line in said.stdout.splitlines() if "looks like" in line)
    options = line.rpartition(": ")[2].split()
    assert len(options) == 7
    mended = run_here(*command, *options, "--json")
    assert mended.returncode == 0, mended.stderr
    content = json.loads(mended.stdout)
    assert content["truth_hint"] is None
    assert content["ate_origin"]["rmse"] < 0.05 * content["path_length"]
    refused = run_here(*command[:2], "--truth", demo_sequence / "poses.txt", "--truth-quaternion", "wxyz")
    assert_refused(refused, "poses.txt", "TUM files alone")


def test_the_turn_about_a_straight_path_is_not_reported_as_an_error(tmp_path: Path):
    """Positions on a line to a millimetre leave the turn about it free; those of a curve do not."""
    generator = np.random.default_rng(1)
    for bend, determined in ((0.0, False), (1.0, True)):
        angles = bend * np.linspace(0, 2, 100)
        poses = np.tile(np.eye(4), (100, 1, 1))
        poses[:, 0, 3], poses[:, 2, 3] = 10 * (1 - np.cos(angles)), 50 * np.linspace(0, 1, 100)
        write_tum(tmp_path / "truth.tum", Trajectory(np.arange(100.0), poses))
        poses[:, :3, 3] += 1e-3 * generator.normal(size=(100, 3))
        poses = poses @ se3_exp(generator.normal(size=(100, 6)) * np.repeat([0.0, 1e-3], 3))
        write_tum(tmp_path / "estimate.tum", Trajectory(np.arange(100.0), poses))
        evaluation = evaluate_run(tmp_path / "estimate.tum", tmp_path / "truth.tum", plot=False)
        assert (evaluation.ate.turn_deg < 1) == determined
        assert ("not determined" in format_evaluation(evaluation)) != determined
        assert evaluation.ate_origin.turn_deg == 0


def test_the_truth_of_a_folder_is_found_by_its_usual_names(tmp_path):
    with pytest.raises(InputError, match=r"folder without groundtruth\.tum, .* give the file"):
        find_truth(tmp_path)
    euroc = tmp_path / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    euroc.parent.mkdir(parents=True)
    euroc.touch()
    assert find_truth(tmp_path) == find_truth(euroc) == euroc
    # What a file is not is said where it is read.
    assert find_truth(tmp_path / "nowhere.txt") == tmp_path / "nowhere.txt"


@pytest.fixture
def flight(real_data: Path, tmp_path: Path) -> tuple[Trajectory, Trajectory]:
    """The real truth of a hand-held flight at 20 Hz, five seconds long, and an estimate that drifts."""
    truth = read_trajectory(real_data / "euroc_mh01_f000_099" / "groundtruth.tum")
    write_estimate(tmp_path / "estimate.tum", truth)
    return truth, read_trajectory(tmp_path / "estimate.tum")


def spin(times: np.ndarray, rate: float = 3.0) -> Trajectory:
    """A body that moves along a line at 2 m/s and turns about a fixed axis, radians a second."""
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, 3] = times[:, None] * np.array([1.2, -1.6, 0.0])
    poses[:, :3, :3] = rotation_exp(times[:, None] * rate * np.array([0.48, 0.6, 0.64]))
    return Trajectory(times, poses)


@pytest.mark.parametrize(("rate", "begin", "shift"), [(30.0, 0.0, 17), (10.0, 0.004, 4), (200.0, -0.001, 1)])
def test_a_truth_of_another_rate_is_interpolated(rate: float, begin: float, shift: int):
    """A steady motion is met exactly, whatever it turns between two poses."""
    estimate, truth = spin(0.05 * np.arange(1, 60)), spin(begin + np.arange(round(3 * rate) + 2) / rate)
    moved, word = interpolate_truth(estimate, truth)
    rows, there = associate(estimate, moved, 1e-6)
    assert len(rows) == len(associate(estimate, truth)[0]) > len(estimate) / 3
    np.testing.assert_allclose(moved.positions[there], estimate.positions[rows], atol=4e-6)  # of 1 us and 2 m/s
    np.testing.assert_allclose(moved.rotations[there], estimate.rotations[rows], atol=6e-6)  # and 3 radians a second
    assert len(moved) == len(truth)
    assert (np.diff(moved.timestamps) > 0).all()
    assert word is not None
    assert f"poses, {shift} ms from its nearest" in word


def test_what_meets_to_a_microsecond_or_has_no_near_neighbours_stays_to_the_bit():
    estimate = spin(0.05 * np.arange(60))
    for times in (estimate.timestamps, estimate.timestamps[::2] + 9e-7, 0.005 + 0.2 * np.arange(10)):
        truth = spin(times)
        assert interpolate_truth(estimate, truth) == (truth, None)
    gap = spin(np.delete(0.005 + 0.05 * np.arange(60), [20, 21, 22]))  # 0.2 s from pose to pose
    moved, _ = interpolate_truth(estimate, gap)
    changed = moved.timestamps != gap.timestamps[1:]
    assert np.flatnonzero(~changed).tolist() == [19]
    assert len(moved) == len(gap) - 1  # the first has no pose before the frame


def test_a_truth_at_30_hz_gives_the_figures_of_the_frames_own(flight, tmp_path: Path):
    """A spline through the flight's poses is seen at 30 Hz."""
    truth, _ = flight
    since = truth.timestamps - truth.timestamps[0]
    times = np.arange(0.003, since[-1], 1 / 30)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, 3] = CubicSpline(since, truth.positions)(times)
    poses[:, :3, :3] = RotationSpline(since, Rotation.from_matrix(truth.rotations))(times).as_matrix()
    write_tum(tmp_path / "own.tum", truth)
    write_tum(tmp_path / "truth.tum", Trajectory(truth.timestamps[0] + times, poses))
    own, seen = (
        evaluate_run(tmp_path / "estimate.tum", tmp_path / name, plot=False) for name in ("own.tum", "truth.tum")
    )
    assert "interpolated" not in format_evaluation(own)
    assert "The truth is interpolated at 98 poses, 8.3 ms from its nearest" in format_evaluation(seen)
    assert seen.rpe.translation_rmse < 5e-4  # of the nearest poses 5e-3
    assert seen.rpe.rotation_rmse_deg < 0.05
    assert seen.ate.rmse == pytest.approx(own.ate.rmse, rel=0.05)


def test_a_truth_of_positions_alone_is_named(flight, tmp_path: Path):
    truth, estimate = flight
    poses = truth.poses.copy()
    poses[:, :3, :3] = np.eye(3)
    write_tum(tmp_path / "truth.tum", Trajectory(truth.timestamps, poses))
    evaluation = evaluate_run(tmp_path / "estimate.tum", tmp_path / "truth.tum", plot=False)
    assert "The truth never turns, the run by 24 deg: of positions alone" in format_evaluation(evaluation)
    assert evaluation.nees_verdict is None
    assert describe_lack_of_rotation(estimate, truth) is None
    assert describe_lack_of_rotation(Trajectory(truth.timestamps, poses), truth) is None


@pytest.mark.parametrize("offset", [-0.3, 0.1, 0.03])
def test_a_clock_that_is_off_is_told(flight, offset: float):
    truth, estimate = flight
    word = (
        f"has stamps that look about {1e3 * abs(offset):.0f} ms {'later' if offset > 0 else 'earlier'} than the run's"
    )
    assert describe_clock_offset(estimate, Trajectory(truth.timestamps + offset, truth.poses)) == word
    turned = se3_exp(np.array([1.0, 2.0, 3.0, 0.4, 0.5, 0.6])) @ truth.poses @ se3_exp(np.array([0, 0, 0, 1.0, 0, 0]))
    assert describe_clock_offset(estimate, Trajectory(truth.timestamps + offset, turned)) == word


@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.1])
def test_no_clock_is_blamed_for_noise_or_a_steady_motion(flight, noise: float):
    truth, estimate = flight
    errors = se3_exp(noise * np.random.default_rng(5).normal(size=(len(truth), 6)))
    assert describe_clock_offset(estimate, Trajectory(truth.timestamps, truth.poses @ errors)) is None
    steady = spin(0.05 * np.arange(200))
    assert describe_clock_offset(steady, Trajectory(steady.timestamps + 0.1, steady.poses)) is None


def test_two_poses_beside_two_of_the_truth_stay_a_step():
    """Ends without a neighbour are left out only where two poses remain."""
    times, poses = np.array([0.0, 0.1]), np.tile(np.eye(4), (2, 1, 1))
    truth = Trajectory(times + [0.001, 0.002], poses)
    kept, word = interpolate_truth(Trajectory(times, poses), truth)
    assert kept is truth
    assert word is None
