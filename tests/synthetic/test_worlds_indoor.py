"""Rooms, colons, organs and tools: what their generators promise."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from types import ModuleType

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sigmaslam.geometry.camera import CameraModel
from sigmaslam_synthetic.render_choices import MOTIONS
from sigmaslam_synthetic.rendering.renderer import Renderer
from sigmaslam_synthetic.rendering.visibility import Eye
from sigmaslam_synthetic.scene import Scene, Texture
from sigmaslam_synthetic.worlds import colon, organ, room, tool
from sigmaslam_synthetic.worlds.episode import Episode, Wish

pytestmark = pytest.mark.usefixtures("one_thread")
WORLDS = [room, colon, organ, tool]
DURATION = 8.0
TIMES = np.linspace(0.5, DURATION - 0.5, 4)


@cache
def make(world: ModuleType, seed: int, motion: str = "normal", movers: float = 0.0) -> Episode:
    episode = world.generate(np.random.default_rng(seed), Wish(DURATION, motion, movers, textures=1))
    assert isinstance(episode, Episode)
    return episode


@cache
def drawn(world: ModuleType, seed: int, movers: float) -> Renderer:
    """Ready to be looked at, with one texture in place of all: only its geometry is of interest."""
    scene = make(world, seed, movers=movers).scene
    materials = tuple(replace(m, layers=(Texture("noise", 0, 1.0),)) for m in scene.materials)
    return Renderer(replace(scene, materials=materials))


def look(renderer: Renderer, poses: np.ndarray, times: np.ndarray, focal: float) -> tuple[np.ndarray, np.ndarray]:
    """Depth, and body or -1, of views of 40 x 30 pixels, each (V, 30, 40)."""
    sight = renderer.look(Eye(CameraModel(40, 30, focal, focal, 19.5, 14.5)), poses, times)
    view, v, u = np.mgrid[: len(times), :30, :40].reshape(3, -1)
    facet = sight.facet.reshape(-1)
    hit = facet >= 0
    places = torch.from_numpy(np.stack([u, v]).astype(np.float64))
    depth = torch.full(facet.shape, torch.inf, dtype=torch.float64)
    depth[hit] = 1.0 / sight.evaluate(torch.from_numpy(view)[hit], facet[hit], places[:, hit])[2]
    body = torch.where(hit, renderer.body[facet.clamp_min(0)], -1)
    return depth.reshape(-1, 30, 40).numpy(), body.reshape(-1, 30, 40).numpy()


@pytest.mark.long
@pytest.mark.parametrize("world", WORLDS)
def test_world_is_a_function_of_its_seed(world: ModuleType) -> None:
    wish = Wish(DURATION, movers=0.2, textures=1)
    first, again = make(world, 0, movers=0.2), world.generate(np.random.default_rng(0), wish)
    other = make(world, 5)
    assert json.dumps(first.scene.to_json()) == json.dumps(again.scene.to_json())
    assert first.path.to_json() == again.path.to_json()
    assert first.scene.to_json() != other.scene.to_json()


@pytest.mark.parametrize("world", WORLDS)
def test_world_survives_json(world: ModuleType) -> None:
    content = json.dumps(make(world, 0, movers=0.2).scene.to_json())
    assert json.dumps(Scene.from_json(json.loads(content)).to_json()) == content


@pytest.mark.parametrize("world", WORLDS)
def test_world_needs_few_textures(world: ModuleType) -> None:
    scene = world.generate(np.random.default_rng(2), Wish(2.0, movers=0.2, textures=100)).scene
    assert len({(layer.kind, layer.seed) for m in scene.materials for layer in m.layers}) <= 14


@pytest.mark.parametrize(("world", "clearance"), [(room, room.CLEARANCE), (colon, colon.CLEARANCE), (organ, 0.02)])
def test_camera_keeps_clear_of_what_rests(world: ModuleType, clearance: float) -> None:
    turns = Rotation.from_rotvec(
        np.pi / 2 * np.array([[0, 0, 0], [0, 1, 0], [0, 2, 0], [0, 3, 0], [1, 0, 0], [-1, 0, 0]])
    )
    v, u = np.mgrid[:30, :40]
    stretch = np.sqrt(1 + ((u - 19.5) ** 2 + (v - 14.5) ** 2) / 14.0**2)
    episode = make(world, 0, movers=0.2)
    times = np.repeat(TIMES[::2], len(turns))
    poses = episode.path.poses(times)
    poses[:, :3, :3] = poses[:, :3, :3] @ np.tile(turns.as_matrix(), (2, 1, 1))
    depth, body = look(drawn(world, 0, 0.2), poses, times, focal=14.0)
    assert (depth * stretch)[~episode.scene.moving[body]].min() >= clearance


@pytest.mark.parametrize(
    ("world", "nearest", "low", "high"),
    [(room, 0.3, 0.8, 5.0), (colon, 0.008, 0.02, 0.15), (organ, 0.02, 0.05, 0.15), (tool, 0.06, 0.1, 0.25)],
)
def test_depths_are_those_of_the_domain(world: ModuleType, nearest: float, low: float, high: float) -> None:
    episode = make(world, 0, movers=0.2)
    depth, body = look(drawn(world, 0, 0.2), episode.path.poses(TIMES), TIMES, focal=29.0)
    assert (body >= 0).mean() > 0.98
    resting = (body >= 0) & ~episode.scene.moving[body]
    assert depth[resting].min() > nearest
    assert low < np.median(depth[resting]) < high


@pytest.mark.parametrize("world", WORLDS)
def test_movers_cover_about_the_share_wished_for(world: ModuleType) -> None:
    episode = make(world, 0, movers=0.2)
    _, body = look(drawn(world, 0, 0.2), episode.path.poses(TIMES), TIMES, focal=29.0)
    assert 0.1 < (episode.scene.moving[body] & (body >= 0)).mean() < 0.3


def test_instrument_works_60_to_200_mm_away() -> None:
    episode = make(tool, 0, movers=0.2)
    depth, body = look(drawn(tool, 0, 0.2), episode.path.poses(TIMES), TIMES, focal=29.0)
    own = depth[episode.scene.moving[body] & (body >= 0)]
    assert own.min() > 0.035
    assert 0.05 < np.median(own) < 0.2


@pytest.mark.parametrize("world", [colon, organ, tool])
@pytest.mark.parametrize("motion", ["normal", "stops"])
def test_parts_of_a_tool_keep_rigid_to_each_other(world: ModuleType, motion: str) -> None:
    episode = make(world, 0, motion, movers=0.2)
    paths = [body.path for body in episode.scene.bodies if body.path is not None]
    assert len(paths) >= 6
    times = np.linspace(0.0, DURATION, 97)
    shaft = np.linalg.inv(paths[0].poses(times))
    for path in paths[1:]:
        relative = shaft @ path.poses(times)
        assert np.abs(relative[:, :3, :3] - relative[0, :3, :3]).max() < 1e-6
        assert np.abs(relative[:, :3, 3] - relative[0, :3, 3]).max() < 5e-6


@pytest.mark.parametrize(
    ("world", "motion"),
    [(world, motion) for motion in MOTIONS for world in WORLDS if world is room or motion not in ("shaken", "planar")],
)
def test_motion_does_what_it_says(world: ModuleType, motion: str) -> None:
    episode = make(world, 0, motion, movers=0.2) if world is tool else make(world, 5, motion)
    path = episode.path
    if world is tool:
        assert np.ptp(path.poses(TIMES), axis=0).max() == 0
        path = next(body.path for body in episode.scene.bodies if body.path is not None)
    assert path.start == 0.0
    assert path.end >= DURATION - 1e-9
    T = path.poses(np.linspace(0.0, path.end, 401))
    travelled = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    turned = Rotation.from_matrix(np.swapaxes(T[:-1, :3, :3], 1, 2) @ T[1:, :3, :3]).magnitude()
    still = (travelled < 1e-9) & (turned < 1e-6)
    if motion == "rest":
        assert still.all()
        return
    assert turned.sum() > 0.2
    if motion == "stops":
        assert 0.05 < still.mean() < 0.8
    elif motion == "rotation":
        # A tool turns about its tip, and this is its shaft.
        assert np.ptp(T[:, :3, 3], axis=0).max() < (0.2 if world is tool else 1e-9)
    elif motion == "loop":
        gap = np.linalg.inv(T[0]) @ T[-1]
        assert travelled.sum() > 0.005
        assert np.linalg.norm(gap[:3, 3]) < 1e-3 * travelled.sum()
        assert Rotation.from_matrix(gap[:3, :3]).magnitude() < 1e-3
    elif motion == "planar":
        assert np.ptp(T[:, 2, 3]) < 1e-9
        assert travelled.sum() > 0.25 * path.end
    else:
        assert travelled.sum() > 0.01
