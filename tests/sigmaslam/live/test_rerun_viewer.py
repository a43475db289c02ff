"""What is written for Rerun, read back by its own reader, is what the run said."""

import socket
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sigmaslam.live.frame_sink import ThreadedSink
from sigmaslam.live.keyframe_points import KeyframePoints
from sigmaslam.readers import open_sequence
from sigmaslam.readers.trajectory_files import read_tum
from sigmaslam.run_record.frame_table import read_frames
from sigmaslam.runs.request import LiveOptions
from tests.support.commands import assert_refused, run_here
from tests.support.demo_parts import copy_frames
from tests.support.tracked import track

FRAMES = 8


@pytest.fixture(scope="module")
def run(demo_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, and what a viewer would show of it."""
    pytest.importorskip("rerun")
    from sigmaslam.live.rerun_viewer import RerunSink

    folder = tmp_path_factory.mktemp("some")
    sequence = open_sequence(copy_frames(demo_sequence, folder / "sequence", FRAMES))
    sink = ThreadedSink(RerunSink(folder / "run" / "rerun.rrd", sequence.camera))
    track(sequence, folder / "run", "klt", live=LiveOptions(sinks=[sink]))
    return folder / "run"


@pytest.fixture(scope="module")
def logged(run: Path) -> dict[str, list[dict[str, Any]]]:
    """Rows by entity, in the order of frames; names of columns without those of their archetypes."""
    chunk = pytest.importorskip("rerun.chunk")
    rows = defaultdict(list)
    for each in chunk.RrdReader(run / "rerun.rrd").stream().to_chunks():
        for row in each.to_record_batch().to_pylist():
            rows[each.entity_path.lstrip("/")].append({name.split(":")[-1]: value for name, value in row.items()})
    return {name: sorted(found, key=lambda row: row.get("frame") or 0) for name, found in rows.items()}


def column(rows: list[dict[str, Any]], name: str) -> np.ndarray:
    return np.array([row[name][0] for row in rows], dtype=np.float64)


def test_the_camera_is_where_the_trajectory_says_at_the_time_of_the_frame(run, logged, demo_sequence: Path):
    trajectory = read_tum(run / "trajectory.tum")
    T_left_rectified = KeyframePoints(open_sequence(demo_sequence).camera).T_left_rectified
    rows = logged["world/camera"]
    poses = trajectory.poses @ T_left_rectified
    assert len(rows) == FRAMES
    np.testing.assert_allclose(column(rows, "translation"), poses[:, :3, 3], atol=1e-6)
    # Rerun has matrices column by column.
    rotations = column(rows, "mat3x3").reshape(-1, 3, 3).transpose(0, 2, 1)
    np.testing.assert_allclose(rotations, poses[:, :3, :3], atol=1e-6)
    seconds = [row["time"].total_seconds() for row in rows]
    np.testing.assert_allclose(seconds, trajectory.timestamps, atol=1e-6)
    assert [row["frame"] for row in rows] == list(range(FRAMES))


@pytest.mark.long
def test_dense_points_of_keyframes_are_shown(demo_sequence: Path, tmp_path: Path):
    chunk = pytest.importorskip("rerun.chunk")
    source = copy_frames(demo_sequence, tmp_path / "sequence", FRAMES)
    file = tmp_path / "seen.rrd"
    done = run_here(
        *("track", source, "--out", tmp_path / "run", "--dense", tmp_path / "cloud.ply", "--viewer", f"rerun:{file}")
    )
    assert done.returncode == 0, done.stderr
    shown = [each for each in chunk.RrdReader(file).stream().to_chunks() if "/dense/" in each.entity_path]
    keyframes = read_frames(tmp_path / "run" / "frames.csv").columns["keyframe"].sum()
    assert len({each.entity_path for each in shown}) == keyframes > 0


def test_ellipsoids_hold_three_sigma_of_the_position(run, logged):
    covariances = np.load(run / "covariance.npy")
    found = column(logged["world/sigma"], "half_sizes")
    expected = 3.0 * np.sqrt(np.linalg.eigvalsh(covariances[:, :3, :3]).clip(0.0))
    np.testing.assert_allclose(np.sort(found, axis=1), expected, rtol=1e-4, atol=1e-9)
    sigma = column(logged["plots/sigma_position_m"], "scalars")
    np.testing.assert_allclose(sigma, np.sqrt(np.trace(covariances[:, :3, :3], axis1=1, axis2=2)), rtol=1e-9)


def test_plots_images_matches_and_keyframes_are_those_of_the_frames(run, logged):
    frames = read_frames(run / "frames.csv")
    np.testing.assert_array_equal(column(logged["plots/inliers"], "scalars"), frames.columns["inliers"])
    updated = frames.columns["dof"] > 0
    nis = frames.columns["nis"][updated] / frames.columns["dof"][updated]
    np.testing.assert_allclose(column(logged["plots/nis_per_dof"], "scalars"), nis, atol=1e-3)
    inliers = [len(row["positions"] or []) for row in logged["world/camera/image/matches"]]
    assert inliers == frames.columns["inliers"].astype(int).tolist()
    assert len([row for row in logged["world/camera/image"] if row.get("blob")]) == FRAMES
    keyframes = {int(name.rsplit("/", 1)[1]) for name in logged if name.startswith("world/keyframes/")}
    assert keyframes == set(np.flatnonzero(frames.columns["keyframe"] == 1).tolist())
    assert sum(len(row["positions"]) for name in logged if "world/points/" in name for row in logged[name]) > 50


def test_the_path_ends_at_the_last_pose(run, logged):
    trajectory = read_tum(run / "trajectory.tum")
    steps = np.array(logged["world/path/0"][-1]["strips"])
    np.testing.assert_allclose(steps[:, 0], trajectory.positions[:-1], atol=1e-6)
    np.testing.assert_allclose(steps[:, 1], trajectory.positions[1:], atol=1e-6)


@pytest.mark.long
def test_a_viewer_on_the_network_gets_every_frame(run: Path, demo_sequence: Path, tmp_path: Path):
    chunk = pytest.importorskip("rerun.chunk")
    port = free_port()
    command = [sys.executable, "-m", "rerun", "--save", str(tmp_path / "got.rrd"), "--port", str(port)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as viewer:
        assert viewer.stderr is not None
        assert any("Listening" in line for line in iter(viewer.stderr.readline, ""))
        words = ("--frontend", "klt", "--frames", str(FRAMES), "--viewer", f"rerun+http://127.0.0.1:{port}/proxy")
        done = run_here("track", demo_sequence, "--out", tmp_path / "run", *words)
        viewer.terminate()
    assert done.returncode == 0, done.stderr
    chunks = list(chunk.RrdReader(tmp_path / "got.rrd").stream().to_chunks())
    assert sum(each.num_rows for each in chunks if each.entity_path == "/world/camera") == FRAMES
    assert (tmp_path / "run" / "trajectory.tum").read_bytes() == (run / "trajectory.tum").read_bytes()


def test_a_viewer_that_does_not_answer_is_named_before_anything_is_tracked(demo_sequence: Path, tmp_path: Path):
    pytest.importorskip("rerun")
    url = f"rerun+http://127.0.0.1:{free_port()}/proxy"
    done = run_here("track", demo_sequence, "--out", tmp_path / "run", "--viewer", url)
    assert_refused(done, url, "start `rerun` there")
    assert not (tmp_path / "run").exists()


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


@pytest.mark.parametrize("viewer", ["rviz", "rerun:", "rerun:there.mp4", "rerun+http:9876", "http://127.0.0.1:9876"])
def test_what_is_no_viewer_is_refused(demo_sequence: Path, tmp_path: Path, viewer: str):
    pytest.importorskip("rerun")
    done = run_here("track", demo_sequence, "--out", tmp_path / "run", "--frames", "2", "--viewer", viewer)
    assert_refused(done, "--viewer")
    assert not (tmp_path / "run").exists()


def test_without_rerun_the_message_names_the_extra(
    demo_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "rerun", None)
    done = run_here("track", demo_sequence, "--out", tmp_path / "run", "--viewer", "rerun")
    assert_refused(done, "sigmaslam[viewer]")
