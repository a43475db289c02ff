import json
from pathlib import Path as FilePath

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from sigmaslam.geometry.camera import CameraModel
from sigmaslam_synthetic.motion import random_motions
from sigmaslam_synthetic.rendering.renderer import Renderer
from sigmaslam_synthetic.rendering.visibility import Eye
from sigmaslam_synthetic.scene import Scene
from sigmaslam_synthetic.worlds import hall, rubble, street
from sigmaslam_synthetic.worlds.episode import Episode, Wish

DOMAINS = {"street": street.generate, "hall": hall.generate, "rubble": rubble.generate}
DURATION, SHARE = 4.0, 0.2
# 70 degrees across, 4 : 3, as shares are meant.
EYE = Eye(CameraModel(80, 60, 57.1, 57.1, 39.5, 29.5))


def make(domain: str, seed: int, motion: str = "normal", movers: float = 0.0) -> Episode:
    return DOMAINS[domain](np.random.default_rng(seed), Wish(DURATION, motion, movers, textures=1))


@pytest.fixture(scope="module", params=DOMAINS)
def shown(request: pytest.FixtureRequest) -> tuple[str, Episode, Renderer]:
    """An episode with movers, ready to be looked at."""
    episode = make(request.param, 1, movers=SHARE)
    return request.param, episode, Renderer(episode.scene)


@pytest.mark.long
@pytest.mark.parametrize("domain", DOMAINS)
def test_the_seed_alone_makes_the_scene(domain: str):
    first, again, other = (make(domain, seed).scene.to_json() for seed in (0, 0, 1))
    assert first == again
    assert first != other


@pytest.mark.long
@pytest.mark.parametrize("domain", DOMAINS)
def test_the_scene_survives_json(domain: str):
    content = make(domain, 2, movers=SHARE).scene.to_json()
    assert Scene.from_json(json.loads(json.dumps(content))).to_json() == content


@pytest.mark.parametrize("domain", DOMAINS)
def test_textures_are_few_and_of_the_bank(domain: str):
    wish = Wish(DURATION, first_texture=40, textures=3)
    scene = DOMAINS[domain](np.random.default_rng(0), wish).scene
    textures = {(layer.kind, layer.seed) for material in scene.materials for layer in material.layers}
    assert len(textures) <= 14
    assert all(40 <= seed < 43 for _, seed in textures)


@pytest.mark.long
def test_nothing_is_nearer_than_0_3_m(shown: tuple[str, Episode, Renderer]):
    _, episode, renderer = shown
    eye = Eye(CameraModel(40, 30, 20.0, 20.0, 19.5, 14.5))
    times = np.repeat(np.linspace(0, DURATION, 3), 4)
    T = episode.path.poses(times)
    for k, turn in enumerate(0.5 * np.pi * np.arange(len(times))):
        c, s = np.cos(turn), np.sin(turn)
        T[k, :3, :3] = T[k, :3, :3] @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    sight = renderer.look(eye, T, times)
    view, v, u = (sight.facet >= 0).nonzero(as_tuple=True)
    places = torch.stack([u, v]).double()
    depth = 1.0 / sight.evaluate(view, sight.facet[view, v, u], places)[2]
    assert float((depth * eye.rays(places).norm(dim=0)).min()) > 0.3


def test_movers_cover_about_the_wished_share(shown: tuple[str, Episode, Renderer]):
    _, episode, renderer = shown
    times = np.linspace(0.1, DURATION - 0.1, 6)
    facet = renderer.look(EYE, episode.path.poses(times), times).facet
    moving = renderer.surfaces.mover > 0
    share = float((moving[facet.clamp_min(0)] & (facet >= 0)).double().mean())
    assert 0.5 * SHARE < share < 1.5 * SHARE


def test_the_lane_is_free_and_the_camera_is_1_65_m_above_it(shown: tuple[str, Episode, Renderer]):
    domain, episode, renderer = shown
    if domain != "street":
        pytest.skip("there is no lane")
    times = np.linspace(0, DURATION, 400)
    way = episode.path.poses(times)[:, :3, 3]
    still = (renderer.surfaces.mover == 0).numpy()
    origin, u, v = (getattr(renderer.surfaces, name).numpy()[still] for name in ("origin", "edge_u", "edge_v"))
    near = np.linalg.norm(origin[:, :2] - way[200, :2], axis=1) < 60
    parts = np.linspace(0, 1, 7)
    a, b = (x.ravel() for x in np.meshgrid(parts, parts))
    keep = ~renderer.surfaces.triangle.numpy()[still][near, None] | (a + b <= 1)
    points = origin[near, None] + a[:, None] * u[near, None] + b[:, None] * v[near, None]
    points = points[keep]
    away, nearest = cKDTree(way[:, :2]).query(points[:, :2])
    above = points[:, 2] - (way[nearest, 2] - 1.65)
    assert not ((away < 1.3) & (above > 0.2) & (above < 2.3)).any()

    down = episode.path.poses(times[::80])
    down[:, :3, :3] = np.diag([1.0, -1.0, -1.0])
    sight = renderer.look(Eye(CameraModel(3, 3, 300.0, 300.0, 1.0, 1.0)), down, times[::80])
    places = torch.ones(2, len(down), dtype=torch.float64)
    view = torch.arange(len(down))
    height = 1.0 / sight.evaluate(view, sight.resolve(view, places), places)[2]
    assert height.numpy() == pytest.approx(1.65, abs=0.1)


@pytest.mark.long
@pytest.mark.parametrize("domain", DOMAINS)
def test_motions_do_what_they_say(domain: str):
    times = np.linspace(0, DURATION, 401)
    poses = {motion: make(domain, 3, motion, SHARE).path for motion in ("stops", "rotation", "loop", "rest")}
    rest, rotation, loop = (poses[motion].poses(times) for motion in ("rest", "rotation", "loop"))
    assert rest == pytest.approx(np.broadcast_to(rest[0], rest.shape), abs=1e-9)
    assert rotation[:, :3, 3] == pytest.approx(np.broadcast_to(rotation[0, :3, 3], (401, 3)), abs=1e-6)
    assert (rotation[:, :3, 2] @ rotation[0, :3, 2]).min() < np.cos(np.deg2rad(10))
    assert loop[0] == pytest.approx(loop[-1], abs=0.05)
    assert np.linalg.norm(loop[200, :3, 3] - loop[0, :3, 3]) > 1.0
    stopped = poses["stops"]
    assert stopped.end >= DURATION - 1e-9
    speed = np.linalg.norm(np.diff(stopped.poses(np.arange(0, stopped.end, 0.02))[:, :3, 3], axis=0), axis=1)
    assert 0.9 < 0.02 * (speed < 1e-6).sum() < 0.9 * stopped.end


def test_a_real_drive_is_followed(real_data: FilePath):
    profile = real_data / "kitti_gt_trajectories" / "05.txt"
    path = street.generate(np.random.default_rng(0), Wish(DURATION, profile=profile, textures=1)).path
    real = random_motions.drive_profile(profile, DURATION, np.random.default_rng(0))
    times = np.linspace(0, DURATION, 50)
    ours, theirs = path.poses(times), real.poses(times)
    assert ours[:, :2] == pytest.approx(theirs[:, :2])
    assert ours[:, 2, 3] == pytest.approx(theirs[:, 2, 3], abs=0.5)
