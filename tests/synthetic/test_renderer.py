"""The renderer's geometry against independent ways to the same answer, on a small scene with every kind of body."""

import json

import cv2
import numpy as np
import pytest
import torch

from sigmaslam.geometry.camera import CameraModel
from sigmaslam_synthetic.rendering.facets import Facets, join
from sigmaslam_synthetic.rendering.renderer import RenderedViews, Renderer
from sigmaslam_synthetic.rendering.shapes import Box, Cylinder, Ellipsoid, Panel, Tube
from sigmaslam_synthetic.rendering.visibility import Eye
from sigmaslam_synthetic.scene import Body, Lights, Material, Scene, Texture
from sigmaslam_synthetic.truth import at_pixels, flow, transfer
from tests.support.small_worlds import CAMERA, FISHEYE, RADTAN, camera_pose, small_scene

CAMERAS = pytest.mark.parametrize("camera", [CAMERA, RADTAN, FISHEYE], ids=["pinhole", "radtan", "fisheye"])
T_0, T_1 = camera_pose((0.0, 0.0, 1.2)), camera_pose((0.3, -0.2, 1.25), 0.05, -0.2)
MOVING = 6  # index of the body that flies


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(small_scene())


def render(renderer: Renderer, camera: CameraModel, *views: tuple[np.ndarray, float]) -> RenderedViews:
    return renderer.render(Eye(camera), np.stack([T for T, _ in views]), np.array([time for _, time in views]))


def pixel_grid(camera: CameraModel) -> np.ndarray:
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.stack([u, v], axis=-1).astype(np.float64)


def facets_of(renderer: Renderer) -> Facets:
    """All facets in the world at time 0.8, made here from the scene alone."""
    return join([body.shape.facets().placed(body.pose(0.8)) for body in renderer.scene.bodies])


def first_hit(facets: Facets, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest facet (n,) and distance in ray lengths (n,) of rays (n, 3): a linear system for each pair."""
    best, which = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for k in range(len(facets)):
        u, v = facets.edge_u[k], facets.edge_v[k]
        if facets.closed[k] and np.cross(u, v) @ (facets.origin[k] - origin) >= 0:
            continue  # the back side of a closed body
        with np.errstate(divide="ignore", invalid="ignore"):
            solution = np.linalg.solve(
                np.stack([np.broadcast_to(u, rays.shape), np.broadcast_to(v, rays.shape), -rays], axis=-1),
                np.broadcast_to(origin - facets.origin[k], rays.shape)[..., None],
            )[..., 0]
        a, b, t = solution.T
        inside = (a >= 0) & (b >= 0) & ((a + b <= 1) if facets.triangle[k] else ((a <= 1) & (b <= 1)))
        nearer = inside & (t > 0.05) & (t < best)
        best[nearer], which[nearer] = t[nearer], k
    return which, best


@pytest.mark.long
@CAMERAS
def test_what_a_pixel_sees_is_the_first_facet_that_its_ray_meets(renderer: Renderer, camera: CameraModel) -> None:
    views = render(renderer, camera, (T_0, 0.8))
    pixels = np.random.default_rng(0).permutation(pixel_grid(camera).reshape(-1, 2))[:600].astype(int)
    rays = camera.unproject(pixels.astype(float)) @ T_0[:3, :3].T
    facet, depth = first_hit(facets_of(renderer), T_0[:3, 3], rays)
    u, v = pixels.T
    found, found_depth = views.facet[0].numpy()[v, u], views.depth[0].numpy()[v, u]
    # The grid of a distorted camera misses what is thinner than a pixel; without distortion all are exact.
    agree = found == facet
    assert agree.mean() > (0.999 if camera is CAMERA else 0.985)
    np.testing.assert_allclose(found_depth[agree], depth[agree], rtol=1e-9)
    assert 0.5 < np.isfinite(depth).mean() < 1.0  # some sky


@CAMERAS
def test_flow_is_the_reprojected_depth(renderer: Renderer, camera: CameraModel) -> None:
    first, second = render(renderer, camera, (T_0, 0.8)), render(renderer, camera, (T_1, 1.0))
    field = flow(first, second.sight)[0][0].numpy()
    pixels = pixel_grid(camera)
    for moving in (False, True):
        chosen = (first.body[0].numpy() == MOVING) == moving
        chosen &= first.facet[0].numpy() >= 0
        points = camera.unproject(pixels[chosen]) * first.depth[0].numpy()[chosen, None]
        T = np.linalg.inv(T_1) @ T_0
        if moving:
            path = renderer.scene.bodies[MOVING].path
            assert path is not None
            T = np.linalg.inv(T_1) @ path.poses(1.0) @ np.linalg.inv(path.poses(0.8)) @ T_0
        there = points @ T[:3, :3].T + T[:3, 3]
        assert chosen.sum() > 100
        np.testing.assert_allclose(field[chosen], camera.project(there) - pixels[chosen], atol=1e-5)


@pytest.mark.long
@CAMERAS
def test_visible_points_are_those_no_facet_stands_before(renderer: Renderer, camera: CameraModel) -> None:
    first, second = render(renderer, camera, (T_0, 0.8)), render(renderer, camera, (T_1, 0.8))
    pixels = np.random.default_rng(1).uniform(2, [camera.width - 3, camera.height - 3], (700, 2))
    view = torch.zeros(len(pixels), dtype=torch.int64)
    facet, places = at_pixels(first, view, torch.from_numpy(pixels.T.copy()))
    seen = facet >= 0
    moved = transfer(first.sight, view[seen], facet[seen], places[:, seen], second.sight, view[seen])
    points = first.sight.points(view[seen], facet[seen], places[:, seen]).T.numpy()
    path = renderer.scene.bodies[MOVING].path
    assert path is not None
    of_mover = renderer.body[facet[seen]].numpy() == MOVING
    points[of_mover] = points[of_mover] @ path.poses(0.8)[:3, :3].T + path.poses(0.8)[:3, 3]
    rays = points - T_1[:3, 3]
    _, distance = first_hit(facets_of(renderer), T_1[:3, 3], rays)
    local = rays @ T_1[:3, :3]
    inside = (moved.pixels.T.numpy() >= 0).all(axis=1)
    inside &= (moved.pixels.T.numpy() <= [camera.width - 1, camera.height - 1]).all(axis=1)
    expected = inside & (distance > 1 - 1e-5) & (local[:, 2] > 0.05)
    assert (expected == moved.visible.numpy()).mean() > 0.985  # the rest lies within a pixel of an outline
    assert 0.01 < (~expected[inside]).mean() < 0.5


def test_views_of_a_batch_are_the_views_alone(renderer: Renderer) -> None:
    both = render(renderer, CAMERA, (T_0, 0.3), (T_1, 1.4))
    for k, view in enumerate(((T_0, 0.3), (T_1, 1.4))):
        alone = render(renderer, CAMERA, view)
        assert torch.equal(both.facet[k], alone.facet[0])
        assert torch.equal(both.depth[k], alone.depth[0])
        torch.testing.assert_close(both.image[k], alone.image[0], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("camera", [RADTAN, FISHEYE], ids=["radtan", "fisheye"])
def test_undistorting_a_distorted_image_gives_the_ideal_one(renderer: Renderer, camera: CameraModel) -> None:
    ideal = CameraModel(120, 90, 75.0, 75.0, 59.5, 44.5)
    distorted = render(renderer, camera, (T_0, 0.8)).image[0].numpy()
    straight = render(renderer, ideal, (T_0, 0.8)).image[0].numpy()
    where = camera.project(ideal.unproject(pixel_grid(ideal))).astype(np.float32)
    undistorted = cv2.remap(distorted, where[..., 0], where[..., 1], cv2.INTER_LINEAR)
    inside = ((where >= 1) & (where <= [camera.width - 2, camera.height - 2])).all(axis=-1)
    assert inside.mean() > 0.9
    assert np.corrcoef(undistorted[inside], straight[inside])[0, 1] > 0.97
    shifted = np.roll(undistorted, 3, axis=1)
    assert np.corrcoef(shifted[inside], straight[inside])[0, 1] < 0.9  # three pixels off would be seen


def test_image_warped_by_true_flow_is_the_other_image() -> None:
    renderer = Renderer(small_scene(sun=0.0))
    first, second = render(renderer, CAMERA, (T_0, 0.8)), render(renderer, CAMERA, (T_1, 0.8))
    field, visible = flow(first, second.sight)
    where = (pixel_grid(CAMERA) + field[0].numpy()).astype(np.float32)
    warped = cv2.remap(second.image[0].numpy(), where[..., 0], where[..., 1], cv2.INTER_LINEAR)
    seen = visible[0].numpy()
    assert seen.mean() > 0.4
    assert np.corrcoef(warped[seen], first.image[0].numpy()[seen])[0, 1] > 0.93
    assert np.corrcoef(second.image[0].numpy()[seen], first.image[0].numpy()[seen])[0, 1] < 0.8


def plain(brightness: float = 0.5) -> Material:
    return Material(brightness, (Texture("noise", 0, 1.0, 0.0),))


def test_a_box_casts_its_shadow_where_the_sun_says() -> None:
    """A cube of 1 m on the floor, the sun at 45 degrees from -x: the shadow reaches 1 m beyond it along +x."""
    bodies = (Body(Panel(8.0, 8.0), 0), Body(Box((1.0, 1.0, 1.0)), 0, (0.0, 0.0, 0.5)))
    down = np.eye(4)
    down[:3, :3] = np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])
    down[2, 3] = 30.0
    camera = CameraModel(121, 121, 600.0, 600.0, 60.0, 60.0)  # 20 pixels a metre on the floor
    images = [
        render(Renderer(Scene(bodies, (plain(),), Lights(0.2, 1.0, (-1.0, 0.0, 1.0), shadows))), camera, (down, 0.0))
        for shadows in (True, False)
    ]
    darker = (images[0].image[0] < 0.9 * images[1].image[0]).numpy()
    u, v = np.meshgrid((np.arange(121) - 60) / 20, (np.arange(121) - 60) / 20)
    expected = (u > 0.5) & (u < 1.5) & (np.abs(v) < 0.5)
    assert (darker == expected).mean() > 0.985
    np.testing.assert_allclose(darker.sum(), 20 * 20, rtol=0.12)


def test_the_lamp_of_the_camera_falls_off_with_the_square_of_the_distance() -> None:
    levels = []
    for distance in (0.05, 0.1):
        wall = Body(Panel(1.0, 1.0), 0, (0.0, 0.0, distance))
        scene = Scene((wall,), (plain(),), Lights(0.0, 0.0, lamp=0.01), near=0.001)
        image = render(Renderer(scene), CAMERA, (np.eye(4), 0.0)).image[0]
        levels.append(float(image[60, 80]))
    np.testing.assert_allclose(levels[0] / levels[1], 4.0, rtol=1e-3)


def test_haze_takes_light_along_the_whole_ray_and_gives_the_sky_s() -> None:
    """A wall across the view, in clear air and where 2 % of a contrast are left at 39 metres."""
    wall = Body(Panel(60.0, 60.0), 0, (0.0, 0.0, 12.0))
    clear, hazy = (
        render(Renderer(Scene((wall,), (plain(0.3),), Lights(0.5, extinction=k), sky=0.8)), CAMERA, (np.eye(4), 0.0))
        for k in (0.0, 0.1)
    )
    rays = (pixel_grid(CAMERA) - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    left = np.exp(-0.1 * 12.0 * np.hypot(1.0, np.linalg.norm(rays, axis=-1)))
    expected = left * clear.image[0].numpy() + (1 - left) * 0.8
    np.testing.assert_allclose(hazy.image[0].numpy(), expected, rtol=1e-4)


def test_highlights_move_with_the_camera() -> None:
    wall = Body(Panel(1.0, 1.0), 0, (0.0, 0.0, 0.1))
    wet = Material(0.3, (Texture("noise", 0, 1.0, 0.0),), specular=0.5, gloss=200.0)
    renderer = Renderer(Scene((wall,), (wet,), Lights(0.1, 0.0, lamp=0.01), near=0.001))
    aside = np.eye(4)
    aside[0, 3] = 0.02
    brightest = []
    for T in (np.eye(4), aside):
        image = render(renderer, CAMERA, (T, 0.0)).image[0].numpy()
        brightest.append(np.unravel_index(image.argmax(), image.shape))
    # The light sits on the camera: the highlight stays before it, though the wall went by 26 pixels.
    np.testing.assert_allclose(brightest[0], brightest[1], atol=1)
    np.testing.assert_allclose(brightest[0], (59.5, 79.5), atol=1)


def test_fine_texture_far_away_turns_grey_instead_of_aliasing() -> None:
    floor = Body(Panel(400.0, 400.0), 0)
    renderer = Renderer(Scene((floor,), (Material(0.5, (Texture("checker", 1, 10.0, 1.0),)),), Lights(1.0), sky=0.5))
    camera = CameraModel(80, 64, 60.0, 60.0, 39.5, 31.5)
    image = render(renderer, camera, (camera_pose((0.0, 0.0, 1.5), 0.3, -0.05), 0.0)).image[0].numpy()
    assert image[55:].std() > 0.04
    assert image[30:33].std() < 0.2 * image[55:].std()  # 20 m and more away


def test_a_surface_that_reaches_behind_the_camera_has_no_gaps() -> None:
    scene = Scene((Body(Panel(100.0, 100.0), 0),), (plain(),), Lights(1.0), sky=0.0)
    views = render(Renderer(scene), CAMERA, (camera_pose((0.0, 0.0, 1.0), 0.7, -1.0), 0.0))
    assert (views.facet >= 0).all()
    heights = pixel_grid(CAMERA).reshape(-1, 2)
    points = CAMERA.unproject(heights) * views.depth[0].numpy().reshape(-1, 1)
    T = camera_pose((0.0, 0.0, 1.0), 0.7, -1.0)
    np.testing.assert_allclose((points @ T[:3, :3].T + T[:3, 3])[:, 2], 0.0, atol=1e-9)


def facets_centre(shape: Box | Cylinder | Ellipsoid) -> np.ndarray:
    """A point well inside."""
    return np.array([0.0, 0.0, -0.9 if isinstance(shape, Cylinder) and shape.top == 0.0 else 0.0])


@pytest.mark.parametrize(
    ("shape", "area"),
    [
        (Box((1.0, 2.0, 3.0)), 22.0),
        (Cylinder(0.5, 2.0, sides=96), 2 * np.pi * 0.5 * 2.0 + 2 * np.pi * 0.25),
        (Cylinder(0.5, 2.0, top=0.0, sides=96), np.pi * 0.5 * np.hypot(0.5, 2.0) + np.pi * 0.25),
        (Ellipsoid((1.0, 1.0, 1.0), 40), 4 * np.pi),
    ],
    ids=["box", "cylinder", "cone", "ball"],
)
def test_closed_shapes_are_whole_and_face_outwards(shape: Box | Cylinder | Ellipsoid, area: float) -> None:
    facets = shape.facets()
    cross = np.cross(facets.edge_u, facets.edge_v)
    size = np.linalg.norm(cross, axis=1) * np.where(facets.triangle, 0.5, 1.0)
    np.testing.assert_allclose(size.sum(), area, rtol=3e-3)
    # Of a closed surface the normals cancel, and the flux of the place is three times the volume.
    weight = np.where(facets.triangle, 0.5, 1.0)[:, None]
    np.testing.assert_allclose((cross * weight).sum(axis=0), 0.0, atol=1e-9 * area)
    middle = facets.origin + (facets.edge_u + facets.edge_v) * np.where(facets.triangle, 1 / 3, 0.5)[:, None]
    assert (np.einsum("fi,fi->f", cross, middle - facets_centre(shape)) > 0).all()
    assert (np.einsum("fi,fi->f", cross, facets.normals[:, 0]) >= -1e-12).all()


def test_a_tube_is_closed_around_a_camera_within() -> None:
    centreline = tuple((0.02 * np.sin(3 * x), 0.0, 0.2 * x) for x in np.linspace(0, 1, 8))
    tube = Tube(centreline, 0.03, 0.008, 0.03, 0.001, 3, rings=80, sides=40)
    scene = Scene((Body(tube, 0),), (plain(),), Lights(0.1, lamp=0.001), near=0.001)
    T = np.eye(4)
    T[:3, 3] = (0.02 * np.sin(0.3), 0.0, 0.02)
    views = render(Renderer(scene), CAMERA, (T, 0.0))
    assert (views.facet >= 0).all()
    assert 0.005 < float(views.depth.min()) < float(views.depth.max()) < 0.25
    facets = tube.facets()
    towards = np.einsum("fi,fi->f", facets.normals[:, 0], np.cross(facets.edge_u, facets.edge_v))
    assert (towards > 0).all()


def test_a_scene_survives_json_with_every_body(renderer: Renderer) -> None:
    scene = small_scene()
    again = Scene.from_json(json.loads(json.dumps(scene.to_json())))
    assert again.to_json() == scene.to_json()
    first, second = render(renderer, CAMERA, (T_0, 0.8)), render(Renderer(again), CAMERA, (T_0, 0.8))
    assert torch.equal(first.image, second.image)
