import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_path
from sigmaslam.geometry.se3 import rotation_exp, se3_exp
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers.pairing import in_seconds
from sigmaslam.readers.trajectory_files import (
    read_covariances,
    read_euroc_truth,
    read_kitti,
    read_trajectory,
    read_tum,
    trajectory_format,
    write_kitti,
    write_tum,
)


def _trajectory(count: int = 20, origin: float = 1403715273.262142976) -> Trajectory:
    generator = np.random.default_rng(3)
    tangents = np.concatenate([generator.normal(0, 300, (count, 3)), generator.normal(0, 1.5, (count, 3))], axis=1)
    return Trajectory(origin + 0.05 * np.arange(count), se3_exp(tangents))


@pytest.mark.parametrize("origin", [0.0, 1403715273.262142976])
def test_tum_round_trip_is_exact(tmp_path, origin):
    trajectory = _trajectory(origin=origin)
    write_tum(tmp_path / "trajectory.tum", trajectory)
    again = read_trajectory(tmp_path / "trajectory.tum")
    np.testing.assert_allclose(again.timestamps, trajectory.timestamps, rtol=0, atol=1e-9)
    np.testing.assert_allclose(again.poses, trajectory.poses, rtol=0, atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(
    arrays(np.float64, (3, 3), elements=st.floats(-4, 4)),
    arrays(np.float64, (3, 3), elements=st.floats(-1e4, 1e4)),
)
def test_any_poses_survive_both_forms(tmp_path_factory, rotation_vectors, positions):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotation_exp(rotation_vectors), positions
    trajectory = Trajectory(np.array([0.0, 0.1, 0.2]), poses)
    folder = tmp_path_factory.mktemp("round")
    write_tum(folder / "a.tum", trajectory)
    write_kitti(folder / "a.txt", trajectory)
    np.testing.assert_allclose(read_tum(folder / "a.tum").poses, poses, rtol=0, atol=1e-9)
    np.testing.assert_allclose(read_kitti(folder / "a.txt").poses, poses, rtol=1e-11, atol=1e-9)


def test_kitti_round_trip_with_times(tmp_path):
    trajectory = _trajectory(origin=0.0)
    write_kitti(tmp_path / "poses.txt", trajectory, times_path=tmp_path / "times.txt")
    again = read_trajectory(tmp_path / "poses.txt")
    np.testing.assert_allclose(again.timestamps, trajectory.timestamps, atol=1e-9)
    np.testing.assert_allclose(again.poses, trajectory.poses, atol=1e-9)


def test_kitti_without_times_is_10_hz(tmp_path):
    write_kitti(tmp_path / "poses.txt", _trajectory(4))
    np.testing.assert_allclose(read_kitti(tmp_path / "poses.txt").timestamps, [0, 0.1, 0.2, 0.3])


def test_real_kitti_poses_become_orthonormal(real_data: Path):
    trajectory = read_trajectory(real_data / "kitti_gt_trajectories" / "07.txt")
    assert len(trajectory) == 1101
    assert trajectory.path_length == pytest.approx(694.7, abs=0.1)
    gram = np.swapaxes(trajectory.rotations, 1, 2) @ trajectory.rotations
    np.testing.assert_allclose(gram, np.tile(np.eye(3), (1101, 1, 1)), atol=1e-14)


def test_real_kitti_raw_takes_times_beside(real_data: Path):
    trajectory = read_trajectory(real_data / "kitti_raw_0926_0039_a" / "poses.txt")
    assert trajectory.timestamps[1] == 0.103361
    assert trajectory.path_length == pytest.approx(154, abs=1)


@pytest.mark.parametrize("name", ["euroc_v1_01_keyframes_a", "euroc_v1_01_static"])
def test_real_euroc_truth_is_of_the_camera(real_data: Path, name):
    path = real_data / name / "groundtruth.csv"
    assert trajectory_format(path) == "euroc"
    trajectory = read_trajectory(path)
    assert len(trajectory) == {"euroc_v1_01_keyframes_a": 60, "euroc_v1_01_static": 12}[name]
    assert trajectory.timestamps[0] == pytest.approx(1403715273.262142976, abs=1e-6)
    # p_body + R(q) p_BS by hand, with the quaternion sandwich instead of a matrix.
    q = np.array([-0.824237, -0.106942, -0.551702, 0.069433])
    q /= np.linalg.norm(q)
    camera = np.array([-0.0216401454975, -0.064676986768, 0.00981073058949])
    twice = 2 * np.cross(q[:3], camera)
    expected = np.array([0.878895, 2.1834, 0.948427]) + camera + q[3] * twice + np.cross(q[:3], twice)
    np.testing.assert_allclose(trajectory.positions[0], expected, atol=1e-9)


def test_official_euroc_layout_equals_the_excerpt(real_data: Path, tmp_path):
    source = real_data / "euroc_v1_01_static"
    state, camera = tmp_path / "mav0/state_groundtruth_estimate0", tmp_path / "mav0/cam0"
    state.mkdir(parents=True)
    camera.mkdir()
    shutil.copy(source / "cam0/sensor.yaml", camera)
    rows = (source / "groundtruth.csv").read_text().splitlines()[1:]
    header = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
    official = [",".join([row.split(",")[0], *row.split(",")[2:]]) for row in rows]
    (state / "data.csv").write_text(header + "\n".join(official) + "\n")
    again = read_trajectory(state / "data.csv")
    np.testing.assert_array_equal(again.poses, read_euroc_truth(source / "groundtruth.csv").poses)
    beside = shutil.copy(state / "data.csv", tmp_path / "groundtruth_body.csv")
    np.testing.assert_array_equal(read_trajectory(beside).poses, again.poses)


def test_euroc_truth_without_sensor_file_says_what_to_do(tmp_path):
    folder = tmp_path / "a/b/c"
    folder.mkdir(parents=True)
    (folder / "data.csv").write_text("1403715273262142976,0,0,0,1,0,0,0\n")
    with pytest.raises(InputError, match=r"data\.csv.*sensor\.yaml.*T_BS"):
        read_trajectory(folder / "data.csv")


def test_euroc_sensor_file_without_extrinsics_is_named(tmp_path):
    (tmp_path / "cam0_sensor.yaml").write_text("%YAML:1.0\nrate_hz: 20\n")
    (tmp_path / "data.csv").write_text("1403715273262142976,0,0,0,1,0,0,0\n")
    with pytest.raises(InputError, match=r"cam0_sensor\.yaml: key 'T_BS' is missing"):
        read_trajectory(tmp_path / "data.csv")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 0 0 0 0 0 0 1\n0.1 0 0 zero 0 0 0 1\n", r"line 2: 'zero' is not a finite number"),
        ("# c\n\n0 0 0 0 0 0 0 1\n0.1 0 0 nan 0 0 0 1\n", r"line 4: 'nan'"),
        ("0 0 0 0 0 0 0 1\n0.1 0 0 0 0 0 1\n", r"line 2 has 7 columns, not 8"),
        ("0 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n", r"line 2 is 0\.0, the time before is 0\.0: times must increase"),
        ("0 0 0 0 0 0 0 1\n0.1 0 0 0 0 0 0 0\n", r"line 2: the quaternion has length 0"),
        ("1 2 3\n", r"line 1 has 3 columns"),
        ("# only a comment\n", r"holds no poses"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 -1 0\n", r"line 2 holds no rotation"),
        ("1403715273262142976,0,0,0,1\n", r"line 1 has 5 columns"),
    ],
)
def test_bad_files_are_named_with_line_and_value(tmp_path, text, message):
    path = tmp_path / "bad.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=r"bad\.txt: " + message):
        read_trajectory(path)


def test_missing_and_binary_files_are_named(tmp_path):
    with pytest.raises(InputError, match=r"gone\.tum: cannot read the trajectory: no such file"):
        read_trajectory(tmp_path / "gone.tum")
    (tmp_path / "image.png").write_bytes(b"\x89PNG\xff\xfe\x00")
    with pytest.raises(InputError, match=r"image\.png: cannot read the trajectory: is not text"):
        read_trajectory(tmp_path / "image.png")
    with pytest.raises(InputError, match="cannot read the trajectory: Is a directory"):
        read_trajectory(tmp_path)


def test_wrong_number_of_times_is_named(tmp_path):
    write_kitti(tmp_path / "poses.txt", _trajectory(4))
    (tmp_path / "times.txt").write_text("0\n1\n")
    with pytest.raises(InputError, match=r"4 poses.*times\.txt has 2 times"):
        read_trajectory(tmp_path / "poses.txt")


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match=r"\(N, 4, 4\)"):
        Trajectory(np.zeros(3), np.zeros((2, 4, 4)))


def _write_half_and_fail(path):
    path.write_text("half")
    raise LookupError


def test_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "result.txt"
    path.write_text("old")
    with pytest.raises(LookupError), atomic_path(path) as temporary:
        _write_half_and_fail(temporary)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
    with atomic_path(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new"


def test_missing_folder_is_named(tmp_path):
    with pytest.raises(InputError, match=r"no/such\b.*create it"):
        write_tum(tmp_path / "no/such/trajectory.tum", _trajectory(2))


@pytest.mark.parametrize(("factor", "unit"), [(1e9, "nanoseconds"), (1e6, "microseconds"), (1e3, "milliseconds")])
@pytest.mark.parametrize("origin", [0.0, 1.7e9])
def test_times_in_another_unit_are_named(tmp_path, factor, unit, origin):
    """Milliseconds from zero on could be seconds between fixes. A truth's unit is found by `evaluate`."""
    path, times = tmp_path / "truth.tum", [round(factor * (origin + 0.1 * k)) for k in range(9)]
    path.write_text("".join(f"{time} {k} 0 0 0 0 0 1\n" for k, time in enumerate(times)))
    assert len(read_trajectory(path)) == 9
    if unit == "milliseconds" and not origin:
        assert in_seconds(path, times) == times
        with pytest.raises(InputError, match="look like milliseconds"):
            in_seconds(path, times, 20.0)
        return
    with pytest.raises(InputError, match=rf"truth\.tum: times such as .* look like {unit}: write seconds"):
        in_seconds(path, times)


@pytest.mark.parametrize("times", [[0.0, 0.1, 0.2], [1.7e9, 1.7e9 + 1, 1.7e9 + 500], [5.0], [0.0, 900.0, 1800.0]])
def test_times_in_seconds_are_taken(tmp_path, times):
    path = tmp_path / "truth.tum"
    path.write_text("".join(f"{t} {k} 0 0 0 0 0 1\n" for k, t in enumerate(times)))
    np.testing.assert_array_equal(read_trajectory(path).timestamps, times)


@pytest.mark.parametrize("times", [(0.0, 0.1), (1.7e9, 1.7e9 + 0.1), (3,)])
@pytest.mark.parametrize("separator", [",", ", "])
def test_tum_form_with_commas_is_not_taken_for_euroc(tmp_path, times, separator):
    path = tmp_path / "truth.csv"
    path.write_text("".join(separator.join([str(t), *"0000001"]) + "\n" for t in times))
    with pytest.raises(InputError, match=r"truth\.csv: .*replace each comma by a space"):
        read_trajectory(path)


@pytest.mark.parametrize(
    "array", [np.zeros((3, 6, 6)), np.zeros((4, 6)), np.zeros((4, 6, 6), "U3"), np.zeros((4, 6, 6), int)]
)
def test_covariances_of_another_shape_or_type_are_refused(tmp_path, array):
    np.save(tmp_path / "covariance.npy", array)
    with pytest.raises(InputError, match=r"covariance\.npy: is .*needs floating numbers \(4, 6, 6\): both must come"):
        read_covariances(tmp_path / "covariance.npy", 4)


def test_covariances_come_back_in_float64(tmp_path):
    array = np.random.default_rng(0).normal(size=(4, 6, 6)).astype(np.float32)
    np.save(tmp_path / "covariance.npy", array)
    read = read_covariances(tmp_path / "covariance.npy", 4)
    assert read.dtype == np.float64
    np.testing.assert_array_equal(read, array)
