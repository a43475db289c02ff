"""Rendered sequences from the outside: what is in the folder is true, the same again, and read by our readers."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.readers import open_sequence
from sigmaslam_synthetic import render_sequence
from sigmaslam_synthetic.presets import PRESETS
from sigmaslam_synthetic.render_sequence import write_sequence
from sigmaslam_synthetic.rendering import atlas
from sigmaslam_synthetic.simulation import Recipe, Simulation, Studio, simulate

SIZE = {"width": 96, "height": 72}
FAULTS = {"disparity_offset": 1.5, "rotation_error": 0.3}


@pytest.fixture(scope="module", autouse=True)
def quick_textures() -> Iterator[None]:
    """Painting takes seconds a world; where it does not matter what the textures show, smoothed noise will do."""

    def paint(kind: str, size: int, seed: int) -> np.ndarray:
        noise = np.random.default_rng((len(kind), seed)).random((64, 64)).astype(np.float32)
        return cv2.resize((255 * noise).astype(np.uint8), (size, size), interpolation=cv2.INTER_CUBIC)

    with pytest.MonkeyPatch.context() as context:
        context.setattr(atlas, "paint", paint)
        atlas._block.cache_clear()
        yield
    atlas._block.cache_clear()


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=[pytest.mark.long] if name != "tool" else []) for name in sorted(PRESETS)],
)
def rendered(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frames of a preset, with moving things and a badly calibrated pair."""
    out = tmp_path_factory.mktemp("sequence") / str(request.param)
    write_sequence(out, Recipe(request.param, 2, seed=3, movers=0.2, sensor="ideal", **SIZE, **FAULTS))
    return out


def simulation_of(folder: Path) -> Simulation:
    return Simulation.from_json(json.loads((folder / "scene.json").read_text())["simulation"])


def truth_of(folder: Path, frame: int) -> dict[str, np.ndarray]:
    with np.load(folder / "truth" / f"{frame:06d}.npz") as content:
        return dict(content)


def pixel_grid(shape: tuple[int, ...]) -> np.ndarray:
    v, u = np.mgrid[: shape[0], : shape[1]]
    return np.stack([u, v], axis=-1).astype(np.float64)


def carry(points: np.ndarray, body: np.ndarray, simulation: Simulation, T_from: np.ndarray, T_to: np.ndarray, times):
    """Points (n, 3) of one camera frame in another, a moment later; bodies move along."""
    result = np.empty_like(points)
    for k in np.unique(body):
        of_body = body == k
        T = T_from
        if simulation.scene.bodies[k].path is not None:
            before, after = (simulation.scene.bodies[k].pose(time) for time in times)
            T = after @ np.linalg.inv(before) @ T_from
        T = np.linalg.inv(T_to) @ T
        result[of_body] = points[of_body] @ T[:3, :3].T + T[:3, 3]
    return result


@pytest.mark.long
def test_reprojected_depth_is_the_flow_and_the_other_eye(rendered: Path) -> None:
    simulation, truth = simulation_of(rendered), truth_of(rendered, 0)
    rig, times = simulation.rig, (0.0, 1.0 / simulation.fps)
    T_0, T_1 = simulation.path.poses(np.array(times))
    pixels = pixel_grid(truth["depth"].shape)
    for field, camera, T_to, then in (
        ("flow", rig.left, T_1, times),
        ("stereo", rig.true_right, T_0 @ rig.true_right_pose, (0.0, 0.0)),
    ):
        known = np.isfinite(truth[field]).all(axis=-1) & np.isfinite(truth["depth"])
        assert known.mean() > 0.4
        points = rig.left.unproject(pixels[known]) * truth["depth"][known, None].astype(float)
        there = carry(points, truth["body"][known], simulation, T_0, T_to, then)
        difference = camera.project(there) - pixels[known] - truth[field][known]
        assert np.abs(difference).max() < 0.02


def test_triangulated_correspondences_have_the_true_depth(rendered: Path) -> None:
    """By linear triangulation of the two rays, with the true pose of the right camera."""
    simulation, truth = simulation_of(rendered), truth_of(rendered, 0)
    rig = simulation.rig
    seen = truth["stereo_visible"]
    pixels = pixel_grid(seen.shape)[seen]
    left = rig.left.unproject(pixels)
    right = rig.true_right.unproject(pixels + truth["stereo"][seen].astype(float))
    T = rig.true_right_pose
    directions = right @ T[:3, :3].T
    # z left - s direction = origin, least squares over z and s.
    A = np.stack([left, -directions], axis=-1)
    z = np.linalg.pinv(A) @ T[:3, 3]
    depth = truth["depth"][seen]
    # Single precision of a disparity of d pixels gives depth to about 1e-5 / d.
    disparity = np.linalg.norm(truth["stereo"][seen], axis=-1)
    strong = disparity > 0.5
    assert strong.mean() > 0.2
    np.testing.assert_allclose(z[strong, 0], depth[strong], rtol=1e-4)


def test_landmark_tracks_are_what_their_points_project_to(rendered: Path) -> None:
    simulation = simulation_of(rendered)
    with np.load(rendered / "landmarks.npz") as content:
        landmarks = dict(content)
    rig = simulation.rig
    assert len(landmarks["points"]) > 50
    for frame in (0, 1):
        rows = landmarks["track_frame"] == frame
        index = landmarks["track_landmark"][rows]
        assert len(index) > 30
        time = frame / simulation.fps
        T = simulation.path.poses(time)
        world = landmarks["points"][index].copy()
        for k in np.unique(landmarks["body"][index]):
            body = simulation.scene.bodies[k]
            if body.path is not None:
                own = landmarks["body"][index] == k
                world[own] = world[own] @ body.pose(time)[:3, :3].T + body.pose(time)[:3, 3]
        for eye, camera, pose in (("left", rig.left, T), ("right", rig.true_right, T @ rig.true_right_pose)):
            local = (world - pose[:3, 3]) @ pose[:3, :3]
            visible = landmarks[f"track_{eye}_visible"][rows]
            np.testing.assert_allclose(
                camera.project(local)[visible], landmarks[f"track_{eye}"][rows][visible], atol=1e-6
            )
            if eye == "left":
                np.testing.assert_allclose(local[:, 2], landmarks["track_depth"][rows], rtol=1e-9)


def test_our_reader_reads_the_folder_and_its_calibration(rendered: Path) -> None:
    simulation = simulation_of(rendered)
    found = open_sequence(rendered)
    frames = list(found.frames())
    assert found.format == simulation.layout
    assert found.length == len(frames) == 2
    np.testing.assert_allclose(np.diff([frame.timestamp for frame in frames]), 1.0 / simulation.fps, atol=1e-6)
    camera, written = found.camera, simulation.rig.calibrated
    if isinstance(camera, RectifiedStereo):
        np.testing.assert_allclose(camera.baseline, written.baseline, rtol=1e-9)
    assert frames[0].left.std() > 10


def test_instance_ids_name_the_bodies_that_are_seen(rendered: Path) -> None:
    simulation, truth = simulation_of(rendered), truth_of(rendered, 0)
    assert truth["body"].max() < len(simulation.scene.bodies)
    np.testing.assert_array_equal(truth["body"] < 0, np.isinf(truth["depth"]))
    moving = simulation.scene.moving[truth["body"]] & (truth["body"] >= 0)
    assert 0.02 < moving.mean() < 0.6


RECIPE = Recipe("organ", 4, seed=5, **SIZE)


@pytest.fixture(scope="module")
def organ(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("same") / "organ"
    write_sequence(out, RECIPE)
    return out


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.long
def test_a_stopped_sequence_goes_on_to_the_same_bytes(organ: Path, tmp_path: Path) -> None:
    stops: list[int] = []

    def stop(done: int) -> None:
        stops.append(done)
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_sequence(tmp_path / "out", RECIPE, done=stop)
    assert len(list((tmp_path / "out" / "truth").iterdir())) == 2
    assert write_sequence(tmp_path / "out", RECIPE) == 2
    assert files_of(tmp_path / "out") == files_of(organ)


@pytest.mark.long
def test_a_render_killed_before_its_scene_is_written_goes_on_to_the_same_bytes(
    organ: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    with monkeypatch.context() as context:
        context.setattr(render_sequence, "choose_landmarks", lambda studio: (_ for _ in ()).throw(SystemExit))
        with pytest.raises(SystemExit):
            write_sequence(out, RECIPE)
    assert any(out.iterdir())
    assert not (out / "scene.json").exists()
    with pytest.raises(InputError, match="not an empty folder"):
        write_sequence(out, replace(RECIPE, seed=6))
    write_sequence(out, RECIPE)
    assert files_of(out) == files_of(organ)


@pytest.mark.long
def test_another_seed_is_another_sequence(organ: Path) -> None:
    other = Studio(simulate(replace(RECIPE, seed=6))).frames(np.array([0]))[0].left
    first = cv2.imread(str(organ / "image_0" / "000000.png"), cv2.IMREAD_UNCHANGED)
    assert np.abs(first.astype(int) - other).mean() > 5


def test_a_folder_of_another_recipe_is_refused_and_kept(organ: Path, tmp_path: Path) -> None:
    before = files_of(organ)
    with pytest.raises(InputError, match="choose another --out"):
        write_sequence(organ, replace(RECIPE, seed=6))
    assert files_of(organ) == before
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(InputError, match="not an empty folder"):
        write_sequence(tmp_path, RECIPE)


def test_a_folder_of_a_world_that_was_edited_is_refused(tmp_path: Path) -> None:
    world, example = tmp_path / "world.py", Path(__file__).resolve().parents[2] / "examples" / "my_world.py"
    recipe = Recipe("organ", 1, width=64, height=48, world=str(world))
    world.write_text(example.read_text())
    assert [write_sequence(tmp_path / "out", recipe) for _ in range(2)] == [0, 1]
    world.write_text(example.read_text() + "# edited\n")
    with pytest.raises(InputError, match="world_sha256"):
        write_sequence(tmp_path / "out", recipe)


@pytest.mark.long
@pytest.mark.parametrize("frames", [1, 5, 10])
def test_a_short_drive_stops(frames: int) -> None:
    assert simulate(Recipe("street", frames, motion="stops", width=64, height=48)).frames == frames


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"preset": "moon"}, "preset 'moon' is unknown; choose one of room"),
        ({"frames": 0}, "frames is 0"),
        ({"movers": 0.9}, "movers is 0.9"),
        ({"motion": "teleport"}, "choose one of normal"),
        ({"profile": "poses.txt"}, "goes with the preset street"),
        ({"width": 4}, "too small"),
    ],
)
def test_a_wrong_recipe_is_named_before_any_work(change: dict[str, object], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        write_sequence(tmp_path / "out", replace(RECIPE, **change))
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_the_disparity_offset_shifts_the_right_image_alone() -> None:
    recipe = Recipe("organ", 1, seed=4, sensor="ideal", **SIZE)
    plain, shifted = (
        Studio(simulate(replace(recipe, disparity_offset=offset))).frames(np.array([0]))[0] for offset in (0.0, 3.0)
    )
    np.testing.assert_array_equal(plain.left, shifted.left)
    # u_left - u_right grows by 3: what was at column u of the right image is now at u - 3.
    difference = shifted.right[:, :-3].astype(int) - plain.right[:, 3:]
    assert np.abs(difference).mean() < 0.5
    np.testing.assert_allclose(shifted.stereo[..., 0], plain.stereo[..., 0] - 3.0, atol=1e-4)


def test_brightness_is_metered_and_the_eyes_differ_by_the_sensor_alone() -> None:
    frame = Studio(simulate(Recipe("organ", 1, seed=4, sensor="ideal", **SIZE))).frames(np.array([0]))[0]
    assert 60 < frame.left.mean() < 150
    assert abs(float(frame.left.mean()) - float(frame.right.mean())) < 6
    seen = frame.stereo_visible
    where = (pixel_grid(seen.shape) + frame.stereo).astype(np.float32)
    warped = cv2.remap(frame.right, where[..., 0], where[..., 1], cv2.INTER_LINEAR)
    assert np.corrcoef(warped[seen], frame.left[seen])[0, 1] > 0.9
