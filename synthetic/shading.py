"""What light comes from a point that is seen: texture filtered over the pixel's footprint, sun, lamp, highlights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sigmaslam.synthetic.atlas import SIZE, Atlas
from sigmaslam.synthetic.facets import Facets
from sigmaslam.synthetic.scene import Lights, Material
from sigmaslam.synthetic.visibility import Sight

_TAPS = 2  # look-ups along the longer axis of a footprint
_KNEE = 0.49  # albedo stays within 0.5 +- this


class Samples(NamedTuple):
    """N rays that meet something.

    Attributes:
        view, facet: (N,) int64.
        places: (N, 2) float64 on the view's grid.
        spacing: (N,) or a number: side of the square on the grid over which the ray stands for the light.
    """

    view: Tensor
    facet: Tensor
    places: Tensor
    spacing: Tensor | float


class Hits(NamedTuple):
    """Where N rays meet their facets.

    Attributes:
        fraction: (N, 2) float32 a and b along the facet's edges.
        slope: (N, 2, 2) float32, their derivatives by the place on the grid.
        depth: (N,) float64 z, metres.
    """

    fraction: Tensor
    slope: Tensor
    depth: Tensor


def meet(sight: Sight, samples: Samples) -> Hits:
    """Where the rays meet the planes of their facets."""
    values = sight.evaluate(samples.view, samples.facet, samples.places)
    depth = 1.0 / values[:, 2]
    fraction = (values[:, :2] * depth[:, None]).float()
    # Single precision is enough for the size of a footprint.
    by_place = torch.stack(sight.slopes(samples.view, samples.facet), dim=-1).float()
    slope = (by_place[:, :2] - fraction.unsqueeze(-1) * by_place[:, 2:]) * depth.float()[:, None, None]
    return Hits(fraction, slope, depth)


class Shader:
    """Materials and lights on a device.

    Args:
        facets: all facets, in the frame of their mover.
        body, mover: (F,) int of each facet.
        materials: of each body.
        lights: of the scene.
        device: where shading runs.
    """

    def __init__(
        self,
        facets: Facets,
        body: Tensor,
        mover: Tensor,
        materials: Sequence[Material],
        lights: Lights,
        device: torch.device,
    ) -> None:
        self._body, self._mover, self._lights = body, mover, lights
        columns = [facets.uv.reshape(-1, 6), facets.normals.reshape(-1, 9)]
        columns += [facets.origin, facets.edge_u, facets.edge_v]
        self._facets = torch.from_numpy(np.concatenate(columns, axis=1)).float().to(device)
        textures = sorted({(layer.kind, layer.seed) for material in materials for layer in material.layers})
        self._atlas = Atlas(textures, device)
        index = {texture: k for k, texture in enumerate(textures)}
        rows = []
        for material in materials:
            first, second = material.layers[0], material.layers[-1]
            two = len(material.layers) > 1
            rows.append(
                [index[first.kind, first.seed], SIZE / first.tile, first.contrast]
                + [index[second.kind, second.seed], SIZE / second.tile, second.contrast if two else 0.0]
                + [material.brightness, material.specular, material.gloss, material.bump]
            )
        self._materials = torch.tensor(rows, dtype=torch.float32, device=device)

    def points(self, samples: Samples, hits: Hits) -> Tensor:
        """Points (N, 3) float32 in the frames of their movers."""
        record = self._facets.index_select(0, samples.facet)
        a, b = hits.fraction[:, :1], hits.fraction[:, 1:]
        return record[:, 15:18] + a * record[:, 18:21] + b * record[:, 21:24]

    def radiance(
        self,
        sight: Sight,
        samples: Samples,
        hits: Hits,
        points: Tensor,
        lit: Tensor | None,
        T_view_lamp: Tensor,
        taps: int = _TAPS,
    ) -> Tensor:
        """Light towards the camera, (N,) float32.

        Args:
            sight: whose rays they are.
            samples, hits: the rays and where they end.
            points: (N, 3) those ends, as `points` gives them.
            lit: (N,) bool, whether the sun reaches the point; None: it always does.
            T_view_lamp: (V, 4, 4) pose of what carries the lamp, in the views' frames.
            taps: look-ups along the longer axis of a footprint.
        """
        record = self._facets.index_select(0, samples.facet)
        material = self._materials.index_select(0, self._body.index_select(0, samples.facet))
        a, b = hits.fraction[:, :1], hits.fraction[:, 1:]
        uv = record[:, 0:2] + a * record[:, 2:4] + b * record[:, 4:6]
        along = torch.stack([record[:, 2:4], record[:, 4:6]], dim=-1)
        footprint = along @ hits.slope
        spacing = samples.spacing
        footprint = footprint * (spacing if isinstance(spacing, float) else spacing[:, None, None])
        albedo, texels = self._albedo(material, uv, footprint, taps)

        normal = record[:, 6:9] + a * record[:, 9:12] + b * record[:, 12:15]
        normal = normal / normal.norm(dim=1, keepdim=True).clamp_min(1e-9)
        T_mover_view = torch.linalg.inv(sight.T_view_mover)
        where = samples.view * T_mover_view.shape[1] + self._mover.index_select(0, samples.facet)

        def of_mover(vectors: Tensor) -> Tensor:
            return vectors.reshape(-1, 3).float().index_select(0, where)

        towards = of_mover(T_mover_view[..., :3, 3]) - points
        towards = towards / towards.norm(dim=1, keepdim=True).clamp_min(1e-9)
        normal = torch.where((normal * towards).sum(dim=1, keepdim=True) < 0, -normal, normal)
        lights = self._lights
        light = torch.full_like(albedo, lights.ambient)
        shine = torch.zeros_like(albedo)
        wet = (material[:, 7] > 0).nonzero().squeeze(1)
        tilted = self._tilted(material[wet], record[wet], uv[wet], texels[wet], normal[wet])

        def shine_of(strength: Tensor, direction: Tensor) -> Tensor:
            highlight = _highlight(tilted, direction[wet], towards[wet], material[wet])
            return torch.zeros_like(albedo).index_copy(0, wet, strength[wet] * highlight)

        if lights.sun > 0:
            sun = of_mover(self.sun_directions(sight, T_mover_view))
            facing = (normal * sun).sum(dim=1)
            direct = lights.sun * facing.clamp_min(0)
            if lit is not None:
                direct = torch.where(lit, direct, torch.zeros_like(direct))
            # The sky is brighter towards the sun: without it everything in the shade would look flat.
            light = light * (1 + 0.35 * facing) + direct
            shine = shine + shine_of(direct, sun)
        if lights.lamp > 0:
            offset = torch.tensor([*lights.lamp_offset, 1.0], dtype=torch.float64, device=T_view_lamp.device)
            place = (T_mover_view @ (T_view_lamp @ offset)[:, None, :, None])[..., :3, 0]
            reach = of_mover(place) - points
            distance = reach.norm(dim=1, keepdim=True).clamp_min(1e-6)
            reach = reach / distance
            strength = lights.lamp / distance.squeeze(1) ** 2
            light = light + strength * (normal * reach).sum(dim=1).clamp_min(0)
            shine = shine + shine_of(strength, reach)
        return albedo * light + shine

    def sun_directions(self, sight: Sight, T_mover_view: Tensor) -> Tensor:
        """Direction towards the sun in the frame of each mover, (V, M, 3); mover 0 is the world."""
        direction = torch.tensor(self._lights.sun_direction, dtype=torch.float64, device=T_mover_view.device)
        direction = direction / direction.norm()
        R_mover_world = T_mover_view[..., :3, :3] @ sight.T_view_mover[:, :1, :3, :3]
        return R_mover_world @ direction

    def _albedo(self, material: Tensor, uv: Tensor, footprint: Tensor, taps: int) -> tuple[Tensor, Tensor]:
        """Albedo (N,) and the level-0 footprint's shorter side in texels of the first layer (N,)."""
        # The footprint is an ellipse: its axes are the singular values of the Jacobian.
        (xu, xv), (yu, yv) = ((footprint[:, i, 0], footprint[:, i, 1]) for i in (0, 1))
        sum_x, sum_y, cross = xu * xu + xv * xv, yu * yu + yv * yv, xu * yu + xv * yv
        spread = torch.hypot(sum_x - sum_y, 2 * cross)
        major = torch.sqrt(0.5 * (sum_x + sum_y + spread)).clamp_min(1e-12)
        minor = torch.sqrt((0.5 * (sum_x + sum_y - spread)).clamp_min(0))
        angle = 0.5 * torch.atan2(2 * cross, sum_x - sum_y)
        axis = torch.stack([torch.cos(angle), torch.sin(angle)], dim=1)
        size = torch.maximum(minor, major / _TAPS)  # with fewer taps the rays of an edge make up for it
        grey = torch.zeros_like(major)
        scale = material[:, 1]
        level = torch.log2((size * scale).clamp_min(1.0))
        index = material[:, 0].long()
        for k in range(taps):
            offset = (k + 0.5) / taps - 0.5
            place = (uv + (offset * major)[:, None] * axis) * scale[:, None]
            grey = grey + self._atlas.sample(index, place, level) / taps
        deviation = material[:, 2] * (grey - 0.5)
        second = (material[:, 5] != 0).nonzero().squeeze(1)
        if len(second):
            m = material[second]
            level = torch.log2((size[second] * m[:, 4]).clamp_min(1.0))
            other = self._atlas.sample(m[:, 3].long(), uv[second] * m[:, 4:5] + 137.0, level)
            deviation = deviation.index_add(0, second, m[:, 5] * (other - 0.5))
        # A soft knee in place of clipping keeps texture in the dark and the bright parts.
        albedo = 0.5 + _KNEE * torch.tanh((material[:, 6] + deviation - 0.5) / _KNEE)
        return albedo, size * scale

    def _tilted(self, material: Tensor, record: Tensor, uv: Tensor, texels: Tensor, normal: Tensor) -> Tensor:
        """Normals tilted by the slope of the first texture, as a wet, uneven surface has them."""
        scale = material[:, 1]
        step = texels.clamp_min(2.0)
        index, level = material[:, 0].long(), torch.log2(step)
        place = uv * scale[:, None]
        here = self._atlas.sample(index, place, level)
        result = normal
        for axis, edge in ((0, record[:, 18:21]), (1, record[:, 21:24])):
            moved = place.clone()
            moved[:, axis] += step
            slope = (self._atlas.sample(index, moved, level) - here) * material[:, 9]
            tangent = edge / edge.norm(dim=1, keepdim=True).clamp_min(1e-12)
            result = result - slope[:, None] * tangent
        return result / result.norm(dim=1, keepdim=True).clamp_min(1e-9)


def _highlight(normal: Tensor, towards_light: Tensor, towards_eye: Tensor, material: Tensor) -> Tensor:
    """Blinn's highlight, (N,)."""
    half = towards_light + towards_eye
    half = half / half.norm(dim=1, keepdim=True).clamp_min(1e-9)
    return material[:, 7] * (normal * half).sum(dim=1).clamp_min(1e-6) ** material[:, 8]
