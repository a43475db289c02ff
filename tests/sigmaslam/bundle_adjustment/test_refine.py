"""Bundle adjustment: exact data, consistency, outliers, other routes to the same optimum, files."""

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from typer.testing import CliRunner

from sigmaslam.bundle_adjustment import Adjustment, RefineConfig, Tracks, adjust, refine_run
from sigmaslam.bundle_adjustment.refine_run import spread_corrections, spread_covariances
from sigmaslam.bundle_adjustment.structure import collect, fit_structure, point_covariances
from sigmaslam.bundle_adjustment.track_file import TRACKS_NAME
from sigmaslam.cli.commands import app
from sigmaslam.errors import InputError
from sigmaslam.estimation.calibration_errors import measured_errors
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import nearest_rotation, se3_exp, se3_inverse, se3_log
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers.trajectory_files import read_tum, write_tum
from sigmaslam_evaluation.run_evaluation import evaluate_run
from tests.support.quantiles import squared_sigmas
from tests.support.simulated_run import INTRINSICS, OFFSET, Simulation, simulate

pytest.importorskip("gtsam")


def adjust_run(run: Simulation, config: RefineConfig | None = None) -> Adjustment:
    return adjust(run.tracks, run.tracked.poses, run.covariances, config)


def pose_errors(run: Simulation, adjustment: Adjustment) -> np.ndarray:
    """log(T_estimate^-1 T_truth) of the keyframes, (K, 6)."""
    return se3_log(se3_inverse(adjustment.poses) @ run.truth.poses[adjustment.frames])


def nees(errors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Per degree of freedom."""
    return squared_sigmas(errors, covariances) / errors.shape[1]


@pytest.mark.parametrize("without_disparity", [0.0, 0.3])
def test_without_noise_the_trajectory_is_exact(without_disparity: float):
    run = simulate(0, noise=0.0, without_disparity=without_disparity)
    drift = np.linalg.norm((run.tracked.poses - run.truth.poses)[-3, :3, 3])
    assert drift > 0.03
    adjustment = adjust_run(run, RefineConfig(offset_sigma=1e6))
    np.testing.assert_allclose(adjustment.poses, run.truth.poses[adjustment.frames], atol=1e-6)
    assert abs(adjustment.disparity_offset - OFFSET) < 1e-5
    assert adjustment.cost_after < 1e-6 < 1.0 < adjustment.cost_before


@pytest.mark.long
def test_errors_are_as_large_as_the_covariances_say():
    pose, offset, cost = [], [], []
    for seed in range(20):
        run = simulate(seed, keyframes=10, per_keyframe=50, without_disparity=0.1)
        adjustment = adjust_run(run)
        pose.append(nees(pose_errors(run, adjustment)[1:], adjustment.covariances[1:]))
        offset.append((adjustment.disparity_offset - OFFSET) / adjustment.disparity_offset_sigma)
        cost.append(adjustment.cost_after)
    # Last poses: chi-square with 20 x 6 degrees of freedom, standard deviation 0.13.
    assert 0.7 < np.mean([ratios[-1] for ratios in pose]) < 1.35
    assert 0.7 < np.mean(pose) < 1.35
    assert 0.6 < np.sqrt(np.mean(np.square(offset))) < 1.4
    assert abs(np.mean(offset)) < 0.65
    assert 0.97 < np.mean(cost) < 1.03


@pytest.mark.long
def test_points_at_infinity_and_a_lack_of_disparities_do_no_harm():
    ratios, far = [], 0
    for seed in range(8):
        run = simulate(seed, depths=(8.0, 1e6), without_disparity=0.3, per_keyframe=80)
        adjustment = adjust_run(run)
        far += adjustment.far_landmarks
        assert np.isfinite(adjustment.points).all()
        assert np.isfinite(adjustment.point_covariances).all()
        ratios.append(nees(pose_errors(run, adjustment)[1:], adjustment.covariances[1:]).mean())
    assert far > 15
    assert 0.6 < np.mean(ratios) < 1.5


def test_outliers_are_found_and_do_no_harm():
    run = simulate(1)
    rng = np.random.default_rng(5)
    rows = rng.choice(len(run.tracks), 25, replace=False)
    measurement = run.tracks.measurement.copy()
    measurement[rows] += rng.choice([-1, 1], (25, 3)) * rng.uniform(8, 60, (25, 3))
    clean, dirty = adjust_run(run), adjust_run(run.with_measurement(measurement))
    # Landmarks that are seen twice are lost with one wrong view; a few more noisy ones of the others go as well.
    assert clean.outliers <= 5
    assert 20 <= dirty.outliers <= 50
    change = se3_log(se3_inverse(clean.poses[1:]) @ dirty.poses[1:])
    assert nees(change, clean.covariances[1:]).max() < 0.25
    assert abs(dirty.disparity_offset - clean.disparity_offset) < 0.5 * clean.disparity_offset_sigma
    assert dirty.cost_after < 1.1


@pytest.mark.long
def test_scipy_finds_the_same_optimum():
    run = simulate(2, keyframes=4, per_keyframe=18, noise=0.5, depths=(2.0, 8.0), without_disparity=0.1)
    config = RefineConfig(offset_sigma=0.5)
    adjustment = adjust_run(run, config)
    assert adjustment.outliers == adjustment.far_landmarks == adjustment.bridges == 0
    tracks = run.tracks
    seen_twice = np.isin(tracks.landmark, [n for n in set(tracks.landmark) if np.sum(tracks.landmark == n) > 1])
    assert adjustment.observations == seen_twice.sum()
    fx, fy, cx, cy, baseline = INTRINSICS
    landmark = np.unique(tracks.landmark[seen_twice], return_inverse=True)[1]
    poses = len(adjustment.poses)

    def residuals(state: np.ndarray) -> np.ndarray:
        change = np.vstack([np.zeros(6), state[: 6 * poses - 6].reshape(-1, 6)])
        T_world_left = adjustment.poses @ se3_exp(change)
        points, offset = state[6 * poses - 6 : -1].reshape(-1, 3), state[-1]
        result = [offset / config.offset_sigma]
        for row, number in zip(np.flatnonzero(seen_twice), landmark, strict=True):
            T = T_world_left[tracks.frame[row] // 3]
            x, y, z = tracks.R_rectified_left @ (T[:3, :3].T @ (points[number] - T[:3, 3]))
            predicted = np.array([fx * x / z + cx, fy * y / z + cy, fx * baseline / z + offset])
            size = 2 if np.isnan(tracks.measurement[row, 2]) else 3
            root = np.linalg.cholesky(tracks.covariance[row, :size, :size])
            result.extend(np.linalg.solve(root, (predicted - tracks.measurement[row])[:size]))
        return np.array(result)

    start = np.concatenate([np.zeros(6 * poses - 6), adjustment.points.ravel(), [adjustment.disparity_offset]])
    rng = np.random.default_rng(0)
    solution = least_squares(residuals, start + rng.normal(0, 0.003, len(start)), x_scale="jac", xtol=1e-15, ftol=1e-15)
    covariance = np.linalg.inv(solution.jac.T @ solution.jac)
    sigma = np.sqrt(np.diag(covariance))
    # Here both stop at a hundredth of a standard deviation of the offset at most.
    assert np.abs((solution.x - start) / sigma).max() < 0.02
    assert np.sum(residuals(start) ** 2) - 2 * solution.cost < 1e-3
    assert adjustment.cost_after * adjustment.dof == pytest.approx(np.sum(residuals(start)[1:] ** 2))
    assert adjustment.disparity_offset_sigma == pytest.approx(sigma[-1], rel=0.02)
    for k in range(1, poses):
        block = covariance[6 * k - 6 : 6 * k, 6 * k - 6 : 6 * k]
        np.testing.assert_allclose(adjustment.covariances[k], block, rtol=0.05, atol=0.02 * np.abs(block).max())


def test_the_covariances_of_points_are_those_given_the_poses():
    ratios = []
    for seed in range(5):
        run = simulate(seed, drift=0.0, per_keyframe=200)
        observations, frames = collect(run.tracks)
        every = np.ones(len(observations), bool)
        poses = run.tracked.poses[frames].copy()
        poses[:, :3, :3] = poses[:, :3, :3] @ run.tracks.R_rectified_left.T
        exact, _ = collect(run.with_measurement(run.exact).tracks)
        truth = fit_structure(exact, every, poses, OFFSET).points
        structure = fit_structure(observations, every, poses, OFFSET)
        covariances = point_covariances(observations, every, poses, structure.points)
        sure = structure.significance > 20
        assert sure.sum() > 200
        ratios.append(nees((structure.points - truth)[sure], covariances[sure]).mean())
    # Huber's loss costs a little.
    assert 0.9 < np.mean(ratios) < 1.2


def test_a_gap_in_the_tracks_is_bridged_by_the_tracker():
    run = simulate(3, break_at=6)
    adjustment = adjust_run(run)
    assert adjustment.bridges == 1
    after = adjustment.frames >= 18
    assert np.flatnonzero(after)[0] == 6
    motion = se3_inverse(adjustment.poses[5]) @ adjustment.poses[6]
    tracked = se3_inverse(run.tracked.poses[15]) @ run.tracked.poses[18]
    np.testing.assert_allclose(motion, tracked, atol=1e-5)
    # What the gap leaves open is in the covariance.
    growth = np.trace(adjustment.covariances[6]) - np.trace(adjustment.covariances[5])
    assert growth > 0.8 * np.trace(run.covariances[18] - run.covariances[15])
    assert nees(pose_errors(run, adjustment)[1:], adjustment.covariances[1:]).mean() < 3


def test_frames_between_keyframes_share_their_corrections():
    run = simulate(4)
    frames = np.arange(3, 30, 3)
    # A common motion of all keyframes moves every frame, those before the first and after the last too.
    motion = se3_exp(np.array([1.0, 2.0, -0.5, 0.3, -0.2, 0.5]))
    moved = spread_corrections(run.tracked, frames, motion @ run.tracked.poses[frames])
    np.testing.assert_allclose(moved.poses, motion @ run.tracked.poses, atol=1e-12)
    # Keyframes are where they are put; the way between is covered in proportion to time.
    refined = spread_corrections(run.tracked, frames, run.truth.poses[frames])
    np.testing.assert_array_equal(refined.poses[frames], run.truth.poses[frames])
    first, second, between = (refined.poses[k] @ se3_inverse(run.tracked.poses[k]) for k in (6, 9, 7))
    whole = se3_log(se3_inverse(first) @ second)
    np.testing.assert_allclose(se3_log(se3_inverse(first) @ between), whole / 3, atol=1e-12)


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(0).write(tmp_path_factory.mktemp("simulated") / "run")


def test_the_command_writes_what_evaluate_reads(run_folder: Path, tmp_path: Path):
    run, out = simulate(0), tmp_path / "refined"
    result = CliRunner().invoke(app, ["map", "refine", str(run_folder), "--out", str(out)])
    assert result.exit_code == 0, result.output
    printed = json.loads(result.stdout)
    assert printed == json.loads((out / "refine.json").read_text())
    assert printed["keyframes"] == 12
    assert printed["converged"]
    assert printed["disparity_offset"] == pytest.approx(OFFSET, abs=4 * printed["disparity_offset_sigma"])
    assert printed["cost_per_dof_after"] == pytest.approx(1.0, abs=0.15)
    assert printed["versions"]["gtsam"]
    write_tum(tmp_path / "truth.tum", run.truth)
    tracked = evaluate_run(run_folder, tmp_path / "truth.tum", plot=False)
    refined = evaluate_run(out, tmp_path / "truth.tum", plot=False)
    assert refined.matched == len(run.truth)
    assert refined.ate_origin.rmse < 0.3 * tracked.ate_origin.rmse
    assert refined.nees is not None
    covariance = np.load(out / "covariance.npy")
    np.testing.assert_array_equal(covariance[4], covariance[6])  # that of the keyframe after
    assert not covariance[0].any()
    assert (np.trace(covariance[1:], axis1=1, axis2=2) > 0.0).all()
    np.testing.assert_allclose(
        evaluate_run(out / "trajectory.kitti", tmp_path / "truth.tum", plot=False).ate.rmse, refined.ate.rmse, rtol=1e-6
    )
    with np.load(out / "map.npz") as archive:
        assert len(archive["points"]) == len(archive["covariances"]) == len(archive["observations"])
        assert len(archive["points"]) == printed["landmarks"]
        assert archive["observations"].min() >= 2
    assert f"element vertex {printed['landmarks']}\n".encode() in (out / "map.ply").read_bytes()


def test_errors_that_the_run_found_in_the_pair_are_taken_out(run_folder: Path, tmp_path: Path):
    """The run finds a drive's pair turned by 0.08 degrees: it was refined from 0.25 to 0.31 m, now to 0.23."""
    turned = shutil.copytree(run_folder, tmp_path / "turned")
    with np.load(turned / TRACKS_NAME) as archive:
        arrays = dict(archive)
    fx, fy, cx, cy, baseline = arrays["intrinsics"].tolist()
    yaw = measured_errors(RectifiedStereo(fx, fy, cx, cy, baseline, 0, 0), arrays["measurement"])[:, :, 1]
    np.savez(turned / TRACKS_NAME, **arrays | {"measurement": arrays["measurement"] + 1.5 * yaw})
    apart = {}
    for found in ({}, {"yaw": [1.5, 0.1]}):
        (turned / "run.json").write_text(json.dumps({"summary": {"calibration_errors": found}}))
        summary = refine_run(turned, tmp_path / f"out{len(found)}")
        assert summary["calibration_errors"] == found
        apart[len(found)] = read_tum(tmp_path / f"out{len(found)}" / "trajectory.tum").positions
    refine_run(run_folder, tmp_path / "straight")
    straight = read_tum(tmp_path / "straight" / "trajectory.tum").positions
    np.testing.assert_allclose(apart[1], straight, atol=1e-3)
    assert np.abs(apart[0] - straight).max() > 1e-2


def test_two_runs_are_equal_to_the_bit(run_folder: Path, tmp_path: Path):
    for name in ("a", "b"):
        refine_run(run_folder, tmp_path / name)
    for name in ("trajectory.tum", "trajectory.kitti", "covariance.npy", "map.ply"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


def test_the_adjustment_begins_at_the_trajectory_after_the_fact(run_folder: Path, tmp_path: Path):
    run = tmp_path / "run"
    shutil.copytree(run_folder, run)
    said = refine_run(run, tmp_path / "said")
    shutil.copy(tmp_path / "said" / "trajectory.tum", run / "trajectory_final.tum")
    begun = refine_run(run, tmp_path / "final")
    assert begun["cost_per_dof_before"] < said["cost_per_dof_before"]
    assert begun["cost_per_dof_after"] == pytest.approx(said["cost_per_dof_after"], rel=0.02)
    write_tum(run / "trajectory_final.tum", read_tum(run / "trajectory.tum").subset(np.arange(5)))
    with pytest.raises(InputError, match=r"trajectory_final.tum: has 5 poses at other times than the 35"):
        refine_run(run, tmp_path / "refused")


def spoil(change: Callable[[dict[str, np.ndarray]], None]) -> Callable[[Path], None]:
    def write(run: Path) -> None:
        with np.load(run / "tracks.npz") as archive:
            arrays = dict(archive)
        change(arrays)
        np.savez(run / "tracks.npz", **arrays)

    return write


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize(
    ("break_run", "words"),
    [
        (lambda run: (run / "tracks.npz").unlink(), "tracks.npz: no such file; run `sigmaslam track --tracks`"),
        (lambda run: truncate(run / "tracks.npz"), "tracks.npz: is no numpy archive, or is cut off"),
        (lambda run: (run / "tracks.npz").write_bytes(b""), "tracks.npz: is no numpy archive, or is cut off"),
        (lambda run: truncate(run / "covariance.npy"), "covariance.npy: is no numpy array, or is cut off"),
        (lambda run: np.save(run / "covariance.npy", np.zeros((3, 6, 6))), "both must come from the same run"),
        (lambda run: (run / "trajectory.tum").unlink(), "holds no trajectory.tum"),
        (spoil(lambda a: a.pop("landmark")), "tracks.npz: misses landmark"),
        (spoil(lambda a: a.update(frame=a["frame"] + 30)), "which has 35 poses"),
        (spoil(lambda a: a.update(frame=a["frame"] + 0.5)), "frame is float64"),
        (spoil(lambda a: a.update(measurement=a["measurement"][:, :2])), "or floating (720, 3)"),
        (spoil(lambda a: a["measurement"].__setitem__((4, 1), np.nan)), "observation 4 and 0 more: u or v"),
        (spoil(lambda a: a.update(covariance=-a["covariance"])), "observation 0 and 719 more: covariance"),
        (spoil(lambda a: a.update(intrinsics=-a["intrinsics"])), "positive fx, fy and baseline"),
        (spoil(lambda a: a.update(R_rectified_left=np.ones((3, 3)))), "is no rotation"),
        (spoil(lambda a: a.update(frame=np.zeros_like(a["frame"]))), "all observations are of one keyframe"),
        (spoil(lambda a: a.update(landmark=np.arange(len(a["frame"])))), "is seen by two keyframes and near enough"),
    ],
)
def test_a_broken_run_is_refused_with_its_place_and_the_mend(
    run_folder: Path, tmp_path: Path, break_run: Callable[[Path], None], words: str
):
    run = tmp_path / "run"
    run.mkdir()
    for path in run_folder.iterdir():
        (run / path.name).write_bytes(path.read_bytes())
    break_run(run)
    with pytest.raises(InputError) as caught:
        refine_run(run, tmp_path / "out")
    assert words in str(caught.value)


def test_a_folder_that_holds_something_is_not_written_to(run_folder: Path, tmp_path: Path):
    (tmp_path / "mine").write_text("kept")
    with pytest.raises(InputError, match="not an empty folder"):
        refine_run(run_folder, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_the_missing_extra_is_named(run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(InputError, match=r"gtsam is not installed: pip install 'sigmaslam\[graph\]'"):
        refine_run(run_folder, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_gap_without_a_covariance_is_refused():
    run = simulate(3, break_at=6)
    with pytest.raises(InputError, match="break off before keyframe 6"):
        adjust_run(replace(run, covariances=np.zeros_like(run.covariances)))


def test_a_trajectory_of_another_scene_is_refused():
    run = simulate(0)
    other = Trajectory(run.tracked.timestamps, se3_exp(np.random.default_rng(0).normal(0, 2, (35, 6))))
    with pytest.raises(InputError):
        adjust_run(replace(run, tracked=other))


def test_times_and_rows_are_those_of_the_run(run_folder: Path, tmp_path: Path):
    refine_run(run_folder, tmp_path / "out")
    before, after = read_tum(run_folder / "trajectory.tum"), read_tum(tmp_path / "out" / "trajectory.tum")
    np.testing.assert_array_equal(before.timestamps, after.timestamps)
    np.testing.assert_allclose(after.poses[0], before.poses[0], atol=1e-9)


def test_frames_that_were_lost_keep_the_covariance_of_the_run():
    tracked = np.array([0.0, 0.1, 1.0, 900.0, 1.2, 1.3])[:, None, None] * np.eye(6)
    spread = spread_covariances(np.array([0, 4]), np.array([0.0, 0.5])[:, None, None] * np.eye(6), tracked)
    np.testing.assert_array_equal(spread[:, 0, 0], [0.0, 0.5, 0.5, 900.0, 0.5, 0.5])


@pytest.mark.slow
def test_tracks_of_a_real_drive_are_adjusted(real_data: Path):
    folder = real_data / "kitti00_stereo_features_gtsam"
    rows = np.loadtxt(folder / "VO_stereo_factors00s.txt")  # pose, landmark, u left, u right, v, ...
    poses = np.loadtxt(folder / "VO_camera_poses00s.txt")[:, 1:].reshape(-1, 4, 4)
    poses[:, :3, :3] = nearest_rotation(poses[:, :3, :3])
    fx, fy, _, cx, cy, baseline = np.loadtxt(folder / "VO_calibration00s.txt")
    tracks = Tracks(
        rows[:, 0].astype(np.int64),
        rows[:, 1].astype(np.int64),
        np.column_stack([rows[:, 2], rows[:, 4], rows[:, 2] - rows[:, 3]]),
        np.tile(0.3**2 * np.eye(3), (len(rows), 1, 1)),
        np.array([fx, fy, cx, cy, baseline]),
        np.eye(3),
        np.array([0.0, 0.2]),
    )
    adjustment = adjust(tracks, poses, np.zeros((len(poses), 6, 6)))
    assert adjustment.bridges == 0
    assert adjustment.outliers < 0.06 * len(rows)
    assert adjustment.cost_after < adjustment.cost_before < 1.0
    # The poses that come with it are adjusted already, without an offset.
    assert 0.0 < adjustment.disparity_offset < 0.3
    np.testing.assert_allclose(adjustment.poses[-1, :3, 3], poses[-1, :3, 3], atol=0.5)
