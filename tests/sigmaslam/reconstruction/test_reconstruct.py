from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper
from scipy.spatial import cKDTree

from sigmaslam.errors import InputError
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.readers import open_sequence
from sigmaslam.reconstruction.depth_fusion import FusedDepth
from sigmaslam.reconstruction.disparity import DisparityMap, semi_global_disparity
from sigmaslam.reconstruction.live_cloud import CloudSink
from sigmaslam.reconstruction.reconstruct import KeyframeDepth, default_voxel, fuse_keyframes
from sigmaslam.reconstruction.recorded_keyframes import _with_frames_between, open_input, read_recorded_keyframes
from sigmaslam.reconstruction.stereo_network import StereoNetwork
from sigmaslam.run_record.dense_points import read_dense_points
from sigmaslam.run_record.frame_table import read_frames
from sigmaslam.run_record.recorded_run import read_run
from sigmaslam.runs.request import LiveOptions
from tests.support.commands import assert_refused, run_here
from tests.support.demo_parts import copy_frames
from tests.support.tracked import track


@pytest.fixture(scope="module")
def tracked(demo_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the first frames of the demo, beside its input."""
    folder = tmp_path_factory.mktemp("dense")
    copy_frames(demo_sequence, folder / "input", 12)
    assert run_here("track", folder / "input", "--out", folder / "run").returncode == 0
    return folder


@pytest.mark.long
def test_a_run_becomes_a_cloud_and_its_report_shows_it(tracked: Path):
    done = run_here("map", "reconstruct", tracked / "run", "--out", tracked / "cloud.ply")
    assert done.returncode == 0, done.stderr
    summary = json.loads((tracked / "run" / "reconstruction.json").read_text())
    assert f"{summary['points']} points of {summary['keyframes']} keyframes" in done.stdout
    assert f"element vertex {summary['points']}\n".encode() in (tracked / "cloud.ply").read_bytes()
    assert summary["points"] > 1000
    dense = read_dense_points(tracked / "run" / "dense.npz")
    assert len(dense.points) == summary["points"]
    assert read_run(tracked / "run").dense is not None
    report = (tracked / "run" / "report.html").read_text()
    assert '"dense_colours"' in report
    assert len(report) < 8_000_000


@pytest.mark.long
def test_every_second_keyframe_certain_points_and_poses_for_others(tracked: Path):
    keyframes = read_recorded_keyframes(tracked / "run")
    shutil.copytree(tracked / "run", tracked / "again")
    done = run_here(
        *("reconstruct", tracked / "again", "--out", tracked / "few.ply", "--every", "2", "--max-sigma", "0.1"),
        *("--min-views", "1", "--export", tracked / "posed"),
    )
    assert done.returncode == 0, done.stderr
    none = run_here(
        "reconstruct", tracked / "again", "--out", tracked / "none.ply", "--every", "2", "--min-views", "900"
    )
    assert_refused(none, "no point is left: give a smaller --min-views")
    none = run_here("reconstruct", tracked / "again", "--out", tracked / "none.ply", "--max-sigma", "1e-6")
    assert_refused(none, "--max-sigma is 1e-06 m, and no point is known to less than 0.0")
    assert not (tracked / "none.ply").exists()
    summary = json.loads((tracked / "again" / "reconstruction.json").read_text())
    assert summary["keyframes"] == -(-keyframes.count // 2)
    assert summary["points"] > 0
    assert read_dense_points(tracked / "again" / "dense.npz").sigma.max() <= 0.1
    transforms = json.loads((tracked / "posed" / "transforms.json").read_text())
    assert len(transforms["frames"]) == summary["keyframes"] == len(list((tracked / "posed" / "images").iterdir()))
    # The first pose is that of the run: nerfstudio's axes are turned about x.
    first = np.array(transforms["frames"][0]["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
    np.testing.assert_allclose(first[:3, 3], keyframes.poses[0][:3, 3], atol=1e-9)


@pytest.mark.long
def test_a_cloud_made_while_tracking_is_near_that_of_later_and_changes_no_pose(tracked: Path, tmp_path: Path):
    done = run_here("track", tracked / "input", "--out", tmp_path / "run", "--dense", tmp_path / "run" / "cloud.ply")
    assert done.returncode == 0, done.stderr
    for name in ("trajectory.tum", "covariance.npy", "trajectory_final.tum"):
        assert (tmp_path / "run" / name).read_bytes() == (tracked / "run" / name).read_bytes()
    live = read_dense_points(tmp_path / "run" / "dense.npz")
    assert '"dense_colours"' in (tmp_path / "run" / "report.html").read_text()
    assert run_here("map", "reconstruct", tmp_path / "run", "--out", tmp_path / "cloud.ply").returncode == 0
    later = read_dense_points(tmp_path / "run" / "dense.npz")
    assert len(live.points) == pytest.approx(len(later.points), rel=0.2)
    distance = cKDTree(later.points).query(live.points)[0]
    assert np.median(distance / live.sigma) < 0.5
    assert run_here("track", tracked / "input", "--out", tmp_path / "run", "--overwrite").returncode == 0
    assert not (tmp_path / "run" / "cloud.ply").exists()


@pytest.mark.long
def test_points_have_the_colours_of_the_left_images(demo_sequence: Path, tmp_path: Path):
    def tint(k: int, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        blue, red = left.copy(), left.copy()
        blue[:, left.shape[1] // 2 :] //= 2
        red[:, : left.shape[1] // 2] //= 2
        return cv2.merge([blue, left, red]), right

    copy_frames(demo_sequence, tmp_path / "input", 6, tint)
    run = tmp_path / "run"
    assert run_here("track", tmp_path / "input", "--out", run, "--dense", run / "cloud.ply").returncode == 0
    live = read_dense_points(run / "dense.npz")
    assert run_here("map", "reconstruct", run, "--out", tmp_path / "cloud.ply").returncode == 0
    keyframes = read_recorded_keyframes(run)
    camera, pose = keyframes.camera.left, keyframes.poses[0]
    for cloud in (live, read_dense_points(run / "dense.npz")):
        seen = (cloud.points - pose[:3, 3]) @ pose[:3, :3]
        is_left = camera.fx * seen[:, 0] / seen[:, 2] + camera.cx < camera.width / 2
        for rows, ratios in ((is_left, (0.5, 1.0)), (~is_left, (1.0, 0.5))):
            red, green, blue = cloud.colours[rows].astype(float).sum(axis=0)
            np.testing.assert_allclose((red / green, blue / green), ratios, atol=0.1)


@pytest.mark.long
def test_what_a_mask_hides_gives_no_points(tracked: Path, tmp_path: Path):
    image = cv2.imread(str(next((tracked / "input").rglob("*.png"))), cv2.IMREAD_GRAYSCALE)
    mask = np.full_like(image, 255)
    mask[:, mask.shape[1] // 2 :] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    run = tmp_path / "run"
    arguments = "--mask", tmp_path / "mask.png", "--dense", run / "cloud.ply", "--frames", "6"
    assert run_here("track", tracked / "input", "--out", run, *arguments).returncode == 0
    live = read_dense_points(run / "dense.npz").points
    assert run_here("map", "reconstruct", run, "--out", tmp_path / "cloud.ply").returncode == 0
    keyframes = read_recorded_keyframes(run)
    camera, pose = keyframes.camera.left, keyframes.poses[0]
    for points in (live, read_dense_points(run / "dense.npz").points):
        seen = (points - pose[:3, 3]) @ pose[:3, :3]
        u = camera.fx * seen[:, 0] / seen[:, 2] + camera.cx
        assert len(points) > 300
        # The camera moves little, and the windows of pixels before the mask end there.
        assert np.quantile(u, 0.95) < mask.shape[1] // 2


@pytest.mark.long
def test_keyframes_after_a_bump_are_measured_by_what_was_learned_of_it(demo_sequence: Path, tmp_path: Path):
    def lower(k: int, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return left, np.roll(right, 3, axis=0) if k >= 12 else right

    copy_frames(demo_sequence, tmp_path / "input", 24, lower)
    run_here("track", tmp_path / "input", "--out", tmp_path / "run")
    keyframes = read_recorded_keyframes(tmp_path / "run")
    bumped = keyframes.timestamps >= read_frames(tmp_path / "run" / "frames.csv").columns["timestamp"][12] - 1e-3
    assert not keyframes.raised[~bumped].any()
    assert keyframes.raised[bumped] == pytest.approx(3.0, abs=0.3)
    # Of each rig what was said of it last.
    assert len(np.unique(keyframes.disparity_offset_sigma)) == 2
    rectifier = StereoRectifier(keyframes.camera)
    fused = fuse_keyframes(keyframes, open_input(keyframes), rectifier, semi_global_disparity)
    density = {depth.number: np.isfinite(depth.measured.disparity).mean() for depth in fused}
    before, after = ([share for k, share in density.items() if bumped[k] == is_bumped] for is_bumped in (False, True))
    assert np.mean(after) > 0.9 * np.mean(before)


def test_voxels_have_a_size_where_the_first_keyframe_has_no_points():
    camera = RectifiedStereo(400.0, 400.0, 30.0, 20.0, 0.1, 60, 40)
    shape, nothing = (40, 60), np.full((40, 60), np.nan, np.float32)
    single = DisparityMap(np.full(shape, 8.0, np.float32), np.ones(shape, np.float32))
    fused = FusedDepth(nothing, nothing, *np.zeros((2, *shape), np.uint8), np.zeros(shape, bool))
    depth = KeyframeDepth(0, np.zeros((*shape, 3), np.uint8), single, fused, np.eye(4), np.eye(6), 0.1)
    assert default_voxel(depth, camera) == pytest.approx(2 * 5.0 / 400.0, rel=0.02)


def test_points_at_borders_of_what_is_measured_are_left_out():
    shape, borders = (60, 80), np.zeros((60, 80), np.float32)
    borders[20:, 40:] = np.nan
    sure, support = np.where(np.isnan(borders), np.nan, 1e-4).astype(np.float32), np.full(shape, 3, np.uint8)
    fused = FusedDepth(borders + 8.0, sure, support, np.zeros(shape, np.uint8), support > 0)
    single = DisparityMap(fused.disparity, sure)
    depth = KeyframeDepth(0, np.zeros((*shape, 3), np.uint8), single, fused, np.eye(4), np.eye(6), 0.0)
    assert depth.is_point[8:-8, :36].all()
    assert depth.is_point[:16, 8:-8].all()
    assert not depth.is_point[25:, 39:].any()


@pytest.mark.long
def test_each_keyframe_s_points_are_shown_as_they_come_and_lie_on_the_cloud(tracked: Path, tmp_path: Path):
    shown: list[np.ndarray] = []
    sequence = open_sequence(tracked / "input")

    def show(points: np.ndarray, colours: np.ndarray) -> None:
        assert colours.shape == (len(points), 3)
        shown.append(points)

    sink = CloudSink(tmp_path / "cloud.ply", tmp_path / "run", sequence.camera, show)
    track(sequence, tmp_path / "run", "klt", live=LiveOptions(sinks=[sink]))
    dense = read_dense_points(tmp_path / "run" / "dense.npz")
    assert len(shown) == read_recorded_keyframes(tmp_path / "run").count > 1
    distance = cKDTree(np.concatenate(shown)).query(dense.points)[0]
    assert np.median(distance / dense.sigma) < 0.5


def test_an_input_that_has_moved_is_asked_for_and_taken(tracked: Path, tmp_path: Path):
    shutil.copytree(tracked / "run", tmp_path / "run")
    entries = json.loads((tmp_path / "run" / "run.json").read_text())
    (tmp_path / "run" / "run.json").write_text(json.dumps({**entries, "input": str(tmp_path / "gone")}))
    refused = run_here("map", "reconstruct", tmp_path / "run", "--out", tmp_path / "cloud.ply")
    assert refused.returncode == 2
    assert "gone" in refused.stderr
    assert "--input" in refused.stderr
    command = ("reconstruct", tmp_path / "run", "--out", tmp_path / "cloud.ply", "--input", tracked / "input")
    assert run_here(*command).returncode == 0


def test_another_input_is_refused(tracked: Path, demo_sequence: Path, tmp_path: Path):
    other = copy_frames(demo_sequence, tmp_path / "other", 12, slower=3.0)
    command = ("reconstruct", tracked / "run", "--out", tmp_path / "cloud.ply", "--input", other)
    refused = run_here(*command)
    assert refused.returncode == 2
    assert "has no frame at" in refused.stderr
    assert not (tmp_path / "cloud.ply").exists()


@pytest.mark.parametrize("name", ["cloud.xyz", "missing/cloud.ply"])
def test_a_place_that_cannot_be_written_is_refused_before_the_work(tracked: Path, tmp_path: Path, name: str):
    refused = run_here("map", "reconstruct", tracked / "run", "--out", tmp_path / name)
    assert refused.returncode == 2
    assert name.rpartition("/")[2] in refused.stderr


def test_steps_between_keyframes_go_both_ways(tracked: Path):
    keyframes = read_recorded_keyframes(tracked / "run")
    there, covariance = keyframes.step(0, 2)
    back, _ = keyframes.step(2, 0)
    np.testing.assert_allclose(there @ back, np.eye(4), atol=1e-12)
    assert np.linalg.eigvalsh(covariance)[0] > 0.0


def test_long_ways_between_keyframes_are_divided():
    assert _with_frames_between(np.array([0, 2, 14]), 18).tolist() == [0, 2, 6, 10, 14, 17]
    assert _with_frames_between(np.array([0]), 1).tolist() == [0]


def _network(path: Path, channels: int, inputs: int = 2, size: int | str = "side") -> Path:
    """A graph whose disparity is the mean difference of the images."""
    names = [f"image{k}" for k in range(inputs)]
    shape = [1, channels, size, size]
    nodes = [
        helper.make_node("Sub", [names[0], names[-1]], ["difference"]),
        helper.make_node("ReduceMean", ["difference", "axes"], ["disparity"], keepdims=1),
    ]
    graph = helper.make_graph(
        nodes,
        "stereo",
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name in names],
        [helper.make_tensor_value_info("disparity", TensorProto.FLOAT, None)],
        [helper.make_tensor("axes", TensorProto.INT64, [1], [1])],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), path)
    return path


@pytest.mark.parametrize("channels", [1, 3])
def test_a_network_gives_the_disparity_of_the_first_image(tmp_path: Path, channels: int):
    left, right = np.full((40, 40), 50, np.uint8), np.full((40, 40), 30, np.uint8)
    right[:10] = 60
    found = StereoNetwork(_network(tmp_path / "net.onnx", channels))(left, right)
    assert np.isnan(found[:10]).all()
    assert (found[10:] == 20.0).all()


def test_a_network_of_one_size_gives_disparities_of_the_image_s_pixels(tmp_path: Path):
    left, right = np.full((40, 80), 50, np.uint8), np.full((40, 80), 30, np.uint8)
    found = StereoNetwork(_network(tmp_path / "net.onnx", 1, size=20))(left, right)
    assert found.shape == (40, 80)
    np.testing.assert_allclose(found, 80.0)


def test_what_is_no_stereo_network_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="two float32 images"):
        StereoNetwork(_network(tmp_path / "one.onnx", 1, inputs=1))
    with pytest.raises(InputError, match="no such file"):
        StereoNetwork(tmp_path / "none.onnx")
