import json
import logging
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.synthetic import worlds
from sigmaslam.synthetic.scene import Pinhole, Rectangle, Rendering, Scene, render
from sigmaslam.synthetic.sensor import Sensor, expose
from sigmaslam.synthetic.sequence import PRESETS, main, simulate, write_sequence
from sigmaslam.synthetic.trajectories import room_flight, street_drive

DEMO = Path(worlds.__file__).resolve().parent / "demo"
SMALL = {"width": 80, "height": 64}


@pytest.fixture
def quick_textures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dead leaves take 1.5 s a scene; where the texture does not matter, smoothed noise will do."""

    def pool(rng: np.random.Generator, count: int = 6) -> list[np.ndarray]:
        noise = rng.random((count, 128, 128)).astype(np.float32)
        return [np.asarray(cv2.GaussianBlur(n, (0, 0), 2.0)) for n in noise]

    monkeypatch.setattr(worlds, "_texture_pool", pool)


def shift_right(T: np.ndarray, metres: float) -> np.ndarray:
    step = np.eye(4)
    step[0, 3] = metres
    return T @ step


def lift(camera: Pinhole, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """(n, 2) pixels and (n,) depths -> (n, 3) points in the camera frame."""
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ np.linalg.inv(camera.matrix).T
    return rays * depth[:, None]


def carry(T_world_a: np.ndarray, T_world_b: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points of frame a in frame b."""
    T_b_a = np.linalg.inv(T_world_b) @ T_world_a
    return points @ T_b_a[:3, :3].T + T_b_a[:3, 3]


def correspondences(
    camera: Pinhole, first: Rendering, second: Rendering, T_first: np.ndarray, T_second: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pixels of the first view, their truth in the second one, and the second view's own depth there.

    Inverse depth is linear in the pixel over a plane, so bilinear interpolation is exact where all four
    neighbours show the same rectangle; other pixels (edges, occlusions) are left out.
    """
    v, u = np.nonzero(first.rectangle >= 0)
    pixels = np.stack([u, v], axis=-1).astype(float)
    points = carry(T_first, T_second, lift(camera, pixels, first.depth[v, u]))
    seen = points @ camera.matrix.T
    seen = seen[:, :2] / seen[:, 2:]
    corner = np.floor(seen).astype(int)
    fits = (points[:, 2] > 0.05) & (corner >= 0).all(axis=1)
    fits &= (corner[:, 0] < camera.width - 1) & (corner[:, 1] < camera.height - 1)
    pixels, points, seen, corner, u, v = (x[fits] for x in (pixels, points, seen, corner, u, v))
    same = np.ones(len(u), dtype=bool)
    inverse = np.zeros(len(u))
    p, q = (seen - corner).T
    for du, dv, weight in ((0, 0, (1 - p) * (1 - q)), (1, 0, p * (1 - q)), (0, 1, (1 - p) * q), (1, 1, p * q)):
        column, row = corner[:, 0] + du, corner[:, 1] + dv
        same &= second.rectangle[row, column] == first.rectangle[v, u]
        inverse += weight / second.depth[row, column]
    return pixels[same], seen[same], points[same, 2], 1.0 / inverse[same]


@pytest.mark.usefixtures("quick_textures")
@pytest.mark.parametrize("preset", ["room", "street"])
@pytest.mark.parametrize("view", ["other eye", "next frame"])
def test_depth_agrees_with_the_plane_seen_from_elsewhere(preset: str, view: str) -> None:
    simulation = simulate(preset, 2, seed=3, width=120, height=80)
    T_first, camera = simulation.T_world_camera[0], simulation.left
    T_second = shift_right(T_first, simulation.baseline) if view == "other eye" else simulation.T_world_camera[1]
    first = render(simulation.scene, camera, T_first, supersample=1, taps=1)
    second = render(simulation.scene, camera, T_second, supersample=1, taps=1)

    pixels, seen, depth, depth_there = correspondences(camera, first, second, T_first, T_second)

    assert len(pixels) > 0.5 * camera.width * camera.height
    np.testing.assert_allclose(depth_there, depth, rtol=1e-6)
    back = carry(T_second, T_first, lift(camera, seen, depth_there)) @ camera.matrix.T
    assert np.abs(back[:, :2] / back[:, 2:] - pixels).max() < 0.02
    if view == "other eye":
        disparity = camera.fx * simulation.baseline / depth
        np.testing.assert_allclose(pixels[:, 0] - seen[:, 0], disparity, atol=1e-9)
        np.testing.assert_allclose(pixels[:, 1], seen[:, 1], atol=1e-9)


@pytest.mark.usefixtures("quick_textures")
def test_depth_lies_on_the_rectangle_that_is_named() -> None:
    simulation = simulate("room", 1, seed=0, **SMALL)
    T, camera = simulation.T_world_camera[0], simulation.left
    view = render(simulation.scene, camera, T)
    v, u = np.nonzero(view.rectangle >= 0)
    points = carry(T, np.eye(4), lift(camera, np.stack([u, v], axis=-1).astype(float), view.depth[v, u]))

    assert len(points) == camera.width * camera.height  # a room is closed
    assert view.image.dtype == np.float32
    assert view.depth.dtype == np.float64
    for i in np.unique(view.rectangle):
        rectangle = simulation.scene.rectangles[i]
        edges = np.stack([rectangle.edge_u, rectangle.edge_v])
        local = points[view.rectangle[v, u] == i] - rectangle.origin
        share = local @ np.linalg.pinv(edges)
        np.testing.assert_allclose(share @ edges, local, atol=1e-9)
        assert share.min() > -1e-9
        assert share.max() < 1 + 1e-9


def test_right_image_warped_by_true_disparity_is_the_left_image() -> None:
    simulation = simulate("room", 1, seed=0, width=160, height=120)
    T, camera = simulation.T_world_camera[0], simulation.left
    T_right = shift_right(T, simulation.baseline)
    left, right = render(simulation.scene, camera, T), render(simulation.scene, camera, T_right)

    pixels, seen, _, _ = correspondences(camera, left, right, T, T_right)
    u, v = pixels.astype(int).T
    map_u, map_v = seen.astype(np.float32).T[:, None]
    warped = cv2.remap(right.image, map_u, map_v, cv2.INTER_LINEAR)[0]

    assert np.corrcoef(warped, left.image[v, u])[0, 1] > 0.95
    assert np.corrcoef(right.image[v, u], left.image[v, u])[0, 1] < 0.9  # unwarped it is not


def test_fine_texture_far_away_turns_grey_instead_of_aliasing() -> None:
    board = (np.indices((400, 400)).sum(axis=0) % 2 * 255).astype(np.uint8)
    x, y, z = np.eye(3)
    floor = Rectangle(y - 20 * x, 40 * x, 40 * z, board, 200.0)  # 1 m under a camera that looks along it
    camera = Pinhole(60.0, 60.0, 39.5, 31.5, 80, 64)
    view = render(Scene([floor], sky=0.5), camera, np.eye(4))
    assert view.image.std() < 0.02
    np.testing.assert_allclose(view.image.mean(), 0.5, atol=0.01)


@pytest.mark.usefixtures("quick_textures")
def test_same_seed_gives_identical_bytes_and_another_seed_does_not(tmp_path: Path) -> None:
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        write_sequence(tmp_path / name, "room", frames=2, seed=seed, **SMALL)
    contents = [
        {p.relative_to(tmp_path / n): p.read_bytes() for p in (tmp_path / n).rglob("*") if p.is_file()} for n in "abc"
    ]
    assert contents[0] == contents[1]
    assert contents[0].keys() == contents[2].keys()
    for name in ("image_0/000000.png", "image_1/000001.png", "poses.txt"):
        assert contents[0][Path(name)] != contents[2][Path(name)]


@pytest.mark.usefixtures("quick_textures")
@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_folder_is_kitti_with_exact_truth(preset: str, tmp_path: Path) -> None:
    write_sequence(tmp_path / "out", preset, frames=3, seed=1, width=96, height=48)
    simulation = simulate(preset, 3, 1, width=96, height=48)
    lines = (tmp_path / "out" / "calib.txt").read_text().splitlines()
    projections = {line.split(":")[0]: np.fromstring(line.split(":")[1], sep=" ") for line in lines}
    assert list(projections) == ["P0", "P1"]
    left, right = (projections[key].reshape(3, 4) for key in ("P0", "P1"))
    np.testing.assert_allclose(left[:, :3], simulation.left.matrix)
    np.testing.assert_allclose(right[:, :3], left[:, :3])
    np.testing.assert_allclose(-right[0, 3] / right[0, 0], PRESETS[preset].baseline)

    poses = np.loadtxt(tmp_path / "out" / "poses.txt").reshape(3, 3, 4)
    np.testing.assert_array_equal(poses[0], np.eye(4)[:3])
    world = simulation.T_world_camera
    np.testing.assert_allclose(poses, (np.linalg.inv(world[0]) @ world)[:, :3], atol=1e-11)
    times = np.loadtxt(tmp_path / "out" / "times.txt")
    np.testing.assert_allclose(times, np.arange(3) / PRESETS[preset].fps)
    for eye in ("image_0", "image_1"):
        files = sorted((tmp_path / "out" / eye).iterdir())
        assert [f.name for f in files] == ["000000.png", "000001.png", "000002.png"]
        image = cv2.imread(str(files[2]), cv2.IMREAD_UNCHANGED)
        assert image is not None
        assert image.dtype == np.uint8
        assert image.shape == (48, 96)
        assert image.std() > 10


@pytest.mark.usefixtures("quick_textures")
def test_disparity_offset_is_added_to_what_the_calibration_says(tmp_path: Path) -> None:
    clean = Sensor(blur=0.0, read_noise=0.0, photons_at_white=1e12)
    for name, offset in (("plain", 0.0), ("shifted", 3.0)):
        write_sequence(tmp_path / name, "room", 1, 4, disparity_offset=offset, sensor=clean, **SMALL)
    images = {
        (name, eye): cv2.imread(str(tmp_path / name / eye / "000000.png"), cv2.IMREAD_UNCHANGED).astype(int)
        for name in ("plain", "shifted")
        for eye in ("image_0", "image_1")
    }
    # disparity = u_left - u_right grows by 3: what was at column u of the right image is now at u - 3.
    difference = images["shifted", "image_1"][:, :-3] - images["plain", "image_1"][:, 3:]
    assert np.abs(difference).max() <= 1
    assert np.abs(difference).mean() < 0.01
    np.testing.assert_array_equal(images["shifted", "image_0"], images["plain", "image_0"])
    for name in ("calib.txt", "poses.txt"):
        assert (tmp_path / "plain" / name).read_bytes() == (tmp_path / "shifted" / name).read_bytes()


def test_sensor_noise_has_the_variance_of_shot_read_and_quantisation() -> None:
    sensor = Sensor(gain=1.2, blur=0.5, read_noise=1.5, photons_at_white=5000.0)
    photograph = expose(np.full((300, 300), 0.5, np.float32), sensor, np.random.default_rng(0))
    level = 0.5 * 1.2 * 255
    variance = level * 255 / 5000 + 1.5**2 + 1 / 12
    np.testing.assert_allclose(photograph.mean(), level, atol=0.05)
    np.testing.assert_allclose(photograph.var(), variance, rtol=0.03)


@pytest.mark.parametrize("seed", range(5))
def test_paths_are_smooth_and_within_their_limits(seed: int) -> None:
    for path, slowest, fastest, turn in ((room_flight, 0.3, 0.8, 22.0), (street_drive, 5.0, 9.0, 22.0)):
        fps = 100.0
        T = path(np.random.default_rng(seed), 600, fps)
        R = T[:, :3, :3]
        np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(R), 1.0)
        velocity = np.diff(T[:, :3, 3], axis=0) * fps
        speed = np.linalg.norm(velocity, axis=1)
        assert slowest < speed.min()
        assert speed.max() < fastest
        assert np.linalg.norm(np.diff(velocity, axis=0) * fps, axis=1).max() < 6.0
        cosine = (np.trace(R[:-1].transpose(0, 2, 1) @ R[1:], axis1=1, axis2=2) - 1) / 2
        rate = np.rad2deg(np.arccos(np.clip(cosine, -1, 1))) * fps
        assert 5.0 < rate.max() < turn
        assert (R[:, 2, 1] < -0.8).all()  # the camera's y axis points down


def test_a_folder_that_is_not_empty_is_refused(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "mine.txt").write_text("keep")
    with caplog.at_level(logging.ERROR):
        assert main(["room", "--out", str(tmp_path), "--frames", "1"]) == 2
    assert "not an empty folder" in caplog.text
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]
    with pytest.raises(InputError, match="choose one of room, street"):
        write_sequence(tmp_path / "new", "moon", 1, 0)
    with pytest.raises(InputError, match="frames is 0"):
        write_sequence(tmp_path / "new", "room", 0, 0)


def test_shipped_demo_is_what_its_command_renders(tmp_path: Path) -> None:
    recipe = json.loads((DEMO / "scene.json").read_text())
    assert sum(p.stat().st_size for p in DEMO.rglob("*") if p.is_file()) <= 4_000_000
    for eye in ("image_0", "image_1"):
        assert len(list((DEMO / eye).glob("*.png"))) == recipe["frames"] == 40

    words = shlex.split(recipe["command"])[3:]
    words[words.index("DIR")] = str(tmp_path / "again")
    words[words.index("--frames") + 1] = "1"  # one frame is enough: a longer path begins the same
    assert main(words) == 0
    assert (tmp_path / "again/calib.txt").read_text() == (DEMO / "calib.txt").read_text()
    for eye in ("image_0", "image_1"):
        again, shipped = (
            cv2.imread(str(folder / eye / "000000.png"), cv2.IMREAD_UNCHANGED).astype(int)
            for folder in (tmp_path / "again", DEMO)
        )
        # Noise may differ where another processor rounds another way; the picture may not.
        assert np.abs(again - shipped).mean() < 2.5
