"""Images with exact geometry from a scene: any number of views at once, on the CPU or a GPU."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sigmaslam.geometry.camera import CameraModel
from sigmaslam.geometry.se3 import rigid_motion
from sigmaslam_synthetic.rendering.facets import join
from sigmaslam_synthetic.rendering.shading import Samples, Shader, meet
from sigmaslam_synthetic.rendering.visibility import Eye, Sight, Surfaces, move
from sigmaslam_synthetic.scene import Material, Scene

# Places of the sub-samples of a pixel on an edge.
_OFFSETS = ((-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125))
_TAPS = 2  # look-ups along the longer axis of a pixel's footprint
_CHUNK = 1 << 16  # rays shaded at a time on a CPU
_SHIFT_STREAM = 71
_DEPTH_JUMP = 0.05  # relative; larger steps within a smooth surface are edges
_SHADOW_RADIUS = 45.0  # metres around which the sun's shadows are drawn
_SHADOW_GRID = 576  # rays of the sun along either side of that
_SUN_DISTANCE = 40.0  # in radii; far enough to be parallel


@dataclass(frozen=True, slots=True)
class RenderedViews:
    """What V views with the same eye see.

    Attributes:
        image: (V, H, W) float32 radiance.
        depth: (V, H, W) float64 z at the pixels' centres, metres; inf where there is nothing.
        facet: (V, H, W) int64 facet at the pixels' centres, -1 where there is nothing.
        body: (V, H, W) int64 index into `Scene.bodies`, -1 where there is nothing.
        sight: for exact rays between the pixels.
    """

    image: Tensor
    depth: Tensor
    facet: Tensor
    body: Tensor
    sight: Sight


class _Light(NamedTuple):
    """Of N rays: their radiance, the depth at which they end, and whether the sun reaches there."""

    radiance: Tensor
    depth: Tensor
    lit: Tensor


class Renderer:
    """A scene made ready to be looked at.

    Args:
        device: where it is drawn.
    """

    def __init__(self, scene: Scene, device: str | torch.device = "cpu") -> None:
        self.scene = scene
        self.device = torch.device(device)
        moving = [k for k, body in enumerate(scene.bodies) if body.path is not None]
        mover_of = {body: k + 1 for k, body in enumerate(moving)}
        parts = []
        for k, body in enumerate(scene.bodies):
            facets = body.shape.facets()
            facets.uv[:, 0] += _texture_shift(k, scene.materials[body.material])
            parts.append(facets if body.path is not None else facets.placed(body.pose(0.0)))
        facets = join(parts)
        counts = [len(part) for part in parts]
        body_of = np.repeat(np.arange(len(parts)), counts)
        mover = np.repeat([mover_of.get(k, 0) for k in range(len(parts))], counts)

        def tensor(values: np.ndarray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values)).to(self.device)

        self.body = tensor(body_of)
        self.smooth = tensor(facets.surface)
        self.surfaces = Surfaces(
            tensor(facets.origin),
            tensor(facets.edge_u),
            tensor(facets.edge_v),
            tensor(facets.triangle),
            tensor(facets.closed),
            tensor(mover),
        )
        self._movers = [scene.bodies[k] for k in moving]
        materials = [scene.materials[body.material] for body in scene.bodies]
        self._shader = Shader(facets, body_of, self.surfaces.mover, materials, scene.lights, scene.sky, self.device)
        casts = np.array([body.shadow for body in scene.bodies])[body_of]
        self._casters = tensor(np.flatnonzero(casts))
        static = facets.origin[mover == 0]
        reach = np.ptp(static, axis=0).max() if len(static) else 1.0
        self._shadow_radius = float(min(_SHADOW_RADIUS, 0.75 * reach))
        self._shadow_centre = static.mean(axis=0) if len(static) else np.zeros(3)

    def poses(self, times: np.ndarray) -> Tensor:
        """T_world_mover (V, M, 4, 4); mover 0 is the world itself."""
        T = np.tile(np.eye(4), (len(times), len(self._movers) + 1, 1, 1))
        for k, body in enumerate(self._movers):
            assert body.path is not None
            T[:, k + 1] = body.path.poses(times)
        return torch.from_numpy(T).to(self.device)

    def look(self, eye: Eye, T_world_camera: np.ndarray, times: np.ndarray) -> Sight:
        """Geometry alone: V views (V, 4, 4) at times (V,) seconds."""
        T_view_world = torch.from_numpy(np.linalg.inv(T_world_camera)).to(self.device)
        return Sight(self.surfaces, eye, T_view_world[:, None] @ self.poses(times), self.scene.near)

    def sunlight(self, T_world_camera: np.ndarray, times: np.ndarray) -> Sight | None:
        """What the sun sees around V cameras, for their shadows; None where there are none."""
        lights = self.scene.lights
        if lights.sun <= 0 or not lights.shadows or not len(self._casters):
            return None
        radius = self._shadow_radius
        ahead = T_world_camera[:, :3, 3] + 0.6 * radius * T_world_camera[:, :3, 2]
        # In steps, so that the grid of the sun's rays stands still from frame to frame.
        centre = 0.25 * radius * np.round(ahead / (0.25 * radius)) if radius == _SHADOW_RADIUS else self._shadow_centre
        direction = np.array(lights.sun_direction) / np.linalg.norm(lights.sun_direction)
        across = np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])
        across /= np.linalg.norm(across)
        R = np.stack([across, np.cross(-direction, across), -direction], axis=-1)
        place = np.broadcast_to(centre + _SUN_DISTANCE * radius * direction, (len(times), 3))
        T = rigid_motion(R, place)
        side = _SHADOW_GRID
        focal = 0.5 * side * _SUN_DISTANCE
        eye = Eye(CameraModel(side, side, focal, focal, (side - 1) / 2, (side - 1) / 2))
        T_view_world = torch.from_numpy(np.linalg.inv(T)).to(self.device)
        near = (_SUN_DISTANCE - 4.0) * radius
        return Sight(self.surfaces, eye, T_view_world[:, None] @ self.poses(times), near, self._casters)

    def render(
        self,
        eye: Eye,
        T_world_camera: np.ndarray,
        times: np.ndarray,
        T_world_lamp: np.ndarray | None = None,
        sunlight: Sight | None = None,
    ) -> RenderedViews:
        """Draws V views.

        Args:
            eye: the camera of all of them.
            T_world_camera: (V, 4, 4), camera axes x right, y down, z forward.
            times: (V,) seconds, for what moves.
            T_world_lamp: (V, 4, 4) pose of the camera that carries the lamp, the views' own unless given.
            sunlight: of the same times from `sunlight`, made here unless given.
        """
        if sunlight is None:
            sunlight = self.sunlight(T_world_camera, times)
        lamp = T_world_camera if T_world_lamp is None else T_world_lamp
        T_view_lamp = torch.from_numpy(np.linalg.inv(T_world_camera) @ lamp).to(self.device)
        sight = self.look(eye, T_world_camera, times)
        views, height, width = len(times), eye.camera.height, eye.camera.width

        places = eye.centres(self.device).repeat(1, views)
        view = torch.arange(views, device=self.device).repeat_interleave(height * width)
        if eye.ideal:
            facet = sight.facet.reshape(-1)
        else:
            seen = places.isfinite().all(dim=0)
            facet = torch.full_like(view, -1)
            facet[seen] = sight.resolve(view[seen], places[:, seen])
        hit = (facet >= 0).nonzero().squeeze(1)
        spacing = None if eye.ideal else eye.spacing(self.device).repeat(views)[hit]
        samples = Samples(view[hit], facet[hit], places[:, hit], spacing)
        light = self._shade(sight, sunlight, samples, T_view_lamp, _TAPS)
        image = torch.full((len(facet),), self.scene.sky, dtype=torch.float32, device=self.device)
        depth = torch.full((len(facet),), torch.inf, dtype=torch.float64, device=self.device)
        lit = torch.ones_like(facet, dtype=torch.bool)
        image[hit], depth[hit], lit[hit] = light.radiance, light.depth, light.lit
        smooth = torch.where(facet >= 0, self.smooth[facet.clamp_min(0)], -1)
        shape = (views, height, width)
        outline = _steps(smooth.reshape(shape)) | _steps(1.0 / depth.reshape(shape), _DEPTH_JUMP)
        shadow = _steps(lit.reshape(shape))
        mixed = (outline | shadow).reshape(-1).nonzero().squeeze(1)
        if len(mixed):
            was_lit = torch.where(shadow.reshape(-1)[mixed], -1, lit[mixed].long())
            image[mixed] = self._edge_radiance(sight, eye, mixed, view[mixed], was_lit, sunlight, T_view_lamp)
        if not eye.ideal:
            image[~seen] = 0.0
        body = torch.where(facet >= 0, self.body[facet.clamp_min(0)], -1)
        return RenderedViews(
            image.reshape(shape), depth.reshape(shape), facet.reshape(shape), body.reshape(shape), sight
        )

    def _edge_radiance(
        self,
        sight: Sight,
        eye: Eye,
        pixels: Tensor,
        view: Tensor,
        lit: Tensor,
        sunlight: Sight | None,
        T_view_lamp: Tensor,
    ) -> Tensor:
        """Mean light over the sub-samples of pixels (n,) where surfaces meet; lit (n,) 1, 0, or -1 where it varies."""
        count = eye.camera.height * eye.camera.width
        within = pixels % count
        places = torch.cat([eye.centres(self.device, offset)[:, within] for offset in _OFFSETS], dim=1)
        views = view.repeat(len(_OFFSETS))
        seen = places.isfinite().all(dim=0)
        facet = torch.full_like(views, -1)
        facet[seen] = sight.resolve(views[seen], places[:, seen])
        light = torch.full((len(views),), self.scene.sky, dtype=torch.float32, device=self.device)
        hit = (facet >= 0).nonzero().squeeze(1)
        # Each ray stands for a quarter of the pixel; together they filter along the footprint as more taps would.
        size = 0.5 * eye.spacing(self.device)[within].repeat(len(_OFFSETS))[hit]
        samples = Samples(views[hit], facet[hit], places[:, hit], size)
        lit = lit.repeat(len(_OFFSETS))[hit]
        light[hit] = self._shade(sight, sunlight, samples, T_view_lamp, 1, lit).radiance
        return light.reshape(len(_OFFSETS), -1).mean(dim=0)

    def _shade(
        self,
        sight: Sight,
        sunlight: Sight | None,
        samples: Samples,
        T_view_lamp: Tensor,
        taps: int,
        was_lit: Tensor | None = None,
    ) -> _Light:
        """Light of N rays, on the CPU in parts that fit its cache; was_lit (N,) is 0 or 1 where that is known."""
        count = len(samples.view)
        step = _CHUNK if self.device.type == "cpu" else max(count, 1)
        parts = []
        for start in range(0, max(count, 1), step):
            part = samples.part(slice(start, start + step))
            hits, look = meet(sight, part), self._shader.look_up(part.facet)
            points = self._shader.points(look, hits)
            lit = (
                torch.ones_like(part.view, dtype=torch.bool) if was_lit is None else was_lit[start : start + step] != 0
            )
            if sunlight is not None:
                asked = None if was_lit is None else (was_lit[start : start + step] < 0).nonzero().squeeze(1)
                lit = self._lit(sunlight, part, points, lit, asked)
            radiance = self._shader.radiance(sight, part, look, hits, points, lit, T_view_lamp, taps)
            parts.append(_Light(radiance, hits.depth, lit))
        return _Light(*(torch.cat(columns) for columns in zip(*parts, strict=True)))

    def _lit(self, sunlight: Sight, samples: Samples, points: Tensor, lit: Tensor, asked: Tensor | None) -> Tensor:
        """Whether the sun reaches points (3, N) in the frames of their movers, (N,) bool; `lit` but for those asked."""
        view, facet = samples.view, samples.facet
        if asked is not None:
            view, facet, points = view[asked], facet[asked], points[:, asked]
        mover = self.surfaces.mover.index_select(0, facet)
        in_sun = move(sunlight.T_view_mover, view, mover, points.double())
        _, places = sunlight.eye.project(in_sun)
        inside = ((places >= 0) & (places <= _SHADOW_GRID - 1)).all(dim=0)
        reached = ~(sunlight.hidden(view, places.clamp(0, _SHADOW_GRID - 1), 1.0 / in_sun[2], facet) & inside)
        return reached if asked is None else lit.index_copy(0, asked, reached)


def _texture_shift(body: int, material: Material) -> np.ndarray:
    """By how much a body's texture is moved, metres (2,): equal bodies of one material look different."""
    layer = material.layers[0]
    shift = 2 * layer.tile * np.random.default_rng((_SHIFT_STREAM, body)).random(2)
    if layer.kind == "facade":
        shift[1] = 0.0  # storeys begin at the ground
    return np.asarray(shift)


def _steps(values: Tensor, relative: float = 0.0) -> Tensor:
    """Pixels (V, H, W) with a neighbour, across or down, that differs by more than the share `relative`, bool."""
    result = torch.zeros_like(values, dtype=torch.bool)
    for dim in (1, 2):
        size = values.shape[dim] - 1
        first, second = (values.narrow(dim, k, size) for k in (0, 1))
        differs = (first - second).abs() > relative * torch.maximum(first, second) if relative else first != second
        result.narrow(dim, 0, size).logical_or_(differs)
        result.narrow(dim, 1, size).logical_or_(differs)
    return result
