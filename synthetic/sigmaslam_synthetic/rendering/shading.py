"""What light comes from a point that is seen: texture filtered over the pixel's footprint, sun, lamp, highlights."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sigmaslam_synthetic.rendering.atlas import SIZE, Atlas
from sigmaslam_synthetic.rendering.facets import Facets
from sigmaslam_synthetic.rendering.visibility import Sight, apply
from sigmaslam_synthetic.scene import Lights, Material

_LONGEST = 2  # of a footprint's axes, longer by more than this the mip level rises instead
_KNEE = 0.2  # albedo is what was asked for from here to 1 - this; beyond it nears 0 and 1 without reaching them
_TINY = 1e-18


class Samples(NamedTuple):
    """N rays that meet something.

    Attributes:
        view, facet: (N,) int64.
        places: (2, N) float64 on the view's grid.
        spacing: (N,) side of the square on the grid over which the ray stands for the light; None: 1.
    """

    view: Tensor
    facet: Tensor
    places: Tensor
    spacing: Tensor | None

    def part(self, index: slice) -> "Samples":
        """Some of them."""
        spacing = None if self.spacing is None else self.spacing[index]
        return Samples(self.view[index], self.facet[index], self.places[:, index], spacing)


class Hits(NamedTuple):
    """Where N rays meet their facets.

    Attributes:
        fraction: (2, N) float32 a and b along the facet's edges.
        by_u, by_v: (2, N) float32, their derivatives by the place on the grid.
        depth: (N,) float64 z, metres.
    """

    fraction: Tensor
    by_u: Tensor
    by_v: Tensor
    depth: Tensor


class _Look(NamedTuple):
    """Columns of the table of facets, of N samples: surface and material, all (N,) or (k, N) float32."""

    uv: Tensor  # (6, N) place on the surface at the origin, its change along either edge
    normal: Tensor  # (9, N) in the same form
    point: Tensor  # (9, N) in the same form
    texture: Tensor  # (2, N) corner of the first layer's texture in the atlas
    scale: Tensor  # texels a metre of the first layer
    contrast: Tensor
    second: Tensor  # (4, N) the same of the second layer: corner, scale, contrast
    brightness: Tensor
    specular: Tensor
    gloss: Tensor
    bump: Tensor

    def at(self, index: Tensor) -> "_Look":
        """Of some of the samples."""
        return _Look(*(column[..., index] for column in self))


def meet(sight: Sight, samples: Samples) -> Hits:
    """Where the rays meet the planes of their facets."""
    rows = sight.rows(samples.view, samples.facet)
    values = apply(rows, samples.places)
    depth = 1.0 / values[2]
    fraction = (values[:2] * depth).float()
    # Single precision is enough for the size of a footprint.
    z = depth.float()
    by_u, by_v = (
        torch.stack([(rows[k].float() - fraction[i] * rows[6 + j].float()) * z for i, k in ((0, j), (1, 3 + j))])
        for j in (0, 1)
    )
    return Hits(fraction, by_u, by_v, depth)


class Shader:
    """Materials and lights on a device.

    Args:
        facets: all facets, in the frame of their mover.
        body, mover: (F,) int of each facet.
        materials: of each body.
        sky: its radiance.
        device: where shading runs.
    """

    def __init__(
        self,
        facets: Facets,
        body: np.ndarray,
        mover: Tensor,
        materials: Sequence[Material],
        lights: Lights,
        sky: float,
        device: torch.device,
    ) -> None:
        self._mover, self._lights, self._sky = mover, lights, sky
        textures = sorted({(layer.kind, layer.seed) for material in materials for layer in material.layers})
        self._atlas = Atlas(textures, device)
        corner = {texture: self._atlas.corner(k) for k, texture in enumerate(textures)}
        rows = []
        for material in materials:
            first, second = material.layers[0], material.layers[-1]
            two = len(material.layers) > 1
            rows.append(
                [*corner[first.kind, first.seed], SIZE / first.tile, first.contrast]
                + [*corner[second.kind, second.seed], SIZE / second.tile, second.contrast if two else 0.0]
                + [material.brightness, material.specular, material.gloss, material.bump]
            )
        columns = [facets.uv.reshape(-1, 6), facets.normals.reshape(-1, 9)]
        columns += [facets.origin, facets.edge_u, facets.edge_v, np.array(rows)[body]]
        table = np.concatenate(columns, axis=1).T.astype(np.float32)
        self._table = torch.from_numpy(np.ascontiguousarray(table)).to(device)

    def look_up(self, facet: Tensor) -> _Look:
        """What is known of the facets of N samples."""
        table = self._table.index_select(1, facet)
        uv, normal, point, texture, others, second, rest = table.split([6, 9, 9, 2, 2, 4, 4])
        scale, contrast = others
        brightness, specular, gloss, bump = rest
        return _Look(uv, normal, point, texture, scale, contrast, second, brightness, specular, gloss, bump)

    def points(self, look: _Look, hits: Hits) -> Tensor:
        """Points (3, N) float32 in the frames of their movers."""
        return _between(look.point, hits.fraction)

    def radiance(
        self,
        sight: Sight,
        samples: Samples,
        look: _Look,
        hits: Hits,
        points: Tensor,
        lit: Tensor,
        T_view_lamp: Tensor,
        taps: int,
    ) -> Tensor:
        """Light towards the camera, (N,) float32.

        Args:
            sight: whose rays they are.
            samples, look, hits: the rays, what they meet, and where.
            points: (3, N) those places, as `points` gives them.
            lit: (N,) bool, whether the sun reaches the point.
            T_view_lamp: (V, 4, 4) pose of what carries the lamp, in the views' frames.
            taps: look-ups along the longer axis of a footprint.
        """
        uv = _between(look.uv, hits.fraction)
        along_u, along_v = look.uv[2:4], look.uv[4:6]
        across, down = (along_u * d[0] + along_v * d[1] for d in (hits.by_u, hits.by_v))
        if samples.spacing is not None:
            across, down = across * samples.spacing, down * samples.spacing
        albedo, texels = self._albedo(look, uv, across, down, taps)

        T_mover_view = torch.linalg.inv(sight.T_view_mover)
        movers = T_mover_view.shape[1]
        where = None
        if len(T_mover_view) * movers > 1:
            where = samples.view * movers + self._mover.index_select(0, samples.facet)

        def of_mover(vectors: Tensor) -> Tensor:
            columns = vectors.reshape(-1, 3).T.float()
            return columns if where is None else columns.contiguous().index_select(1, where)

        normal = _unit(_between(look.normal, hits.fraction))
        towards = of_mover(T_mover_view[..., :3, 3]) - points
        # Seen from behind, a surface shows its other side.
        normal = normal * torch.sign(_dot(normal, towards))
        wet = (look.specular > 0).nonzero().squeeze(1)
        wet_look, wet_towards = look.at(wet), _unit(towards[:, wet])
        tilted = self._tilted(wet_look, uv[:, wet], texels[wet], normal[:, wet])

        def shine(strength: Tensor, direction: Tensor) -> Tensor:
            if not len(wet):
                return torch.zeros_like(strength)
            there = direction[:, wet] if direction.shape[1] > 1 else direction
            # Blinn's highlight.
            mirrored = _dot(tilted, _unit(there + wet_towards)).clamp_min(1e-6)
            light = strength[wet] * (wet_look.specular * mirrored**wet_look.gloss)
            return torch.zeros_like(strength).index_copy(0, wet, light)

        lights = self._lights
        light = torch.full_like(albedo, lights.ambient)
        result = torch.zeros_like(albedo)
        if lights.sun > 0:
            sun = of_mover(self._sun_directions(sight, T_mover_view))
            facing = _dot(normal, sun)
            direct = lights.sun * facing.clamp_min(0) * lit
            # The sky is brighter towards the sun: without it everything in the shade would look flat.
            light = light * (1 + 0.35 * facing) + direct
            result = result + shine(direct, sun)
        if lights.lamp > 0:
            offset = torch.tensor([*lights.lamp_offset, 1.0], dtype=torch.float64, device=T_view_lamp.device)
            place = (T_mover_view @ (T_view_lamp @ offset)[:, None, :, None])[..., :3, 0]
            reach = of_mover(place) - points
            square = _dot(reach, reach).clamp_min(1e-12)
            reach = reach * torch.rsqrt(square)
            strength = lights.lamp / square
            light = light + strength * _dot(normal, reach).clamp_min(0)
            result = result + shine(strength, reach)
        result = torch.addcmul(result, albedo, light)
        if lights.extinction > 0:
            clear = torch.exp(-lights.extinction * torch.linalg.vector_norm(towards, dim=0))
            result = torch.lerp(torch.full_like(result, self._sky), result, clear)
        return result

    def _sun_directions(self, sight: Sight, T_mover_view: Tensor) -> Tensor:
        """Direction towards the sun in the frame of each mover, (V, M, 3); mover 0 is the world."""
        direction = torch.tensor(self._lights.sun_direction, dtype=torch.float64, device=T_mover_view.device)
        direction = direction / direction.norm()
        R_mover_world = T_mover_view[..., :3, :3] @ sight.T_view_mover[:, :1, :3, :3]
        return R_mover_world @ direction

    def _albedo(self, look: _Look, uv: Tensor, across: Tensor, down: Tensor, taps: int) -> tuple[Tensor, Tensor]:
        """Albedo (N,) and the footprint's shorter side in texels of the first layer (N,)."""
        # The footprint is an ellipse: its axes are the singular values of the Jacobian (across, down).
        (xu, yu), (xv, yv) = across, down
        sum_x, sum_y, cross = xu * xu + xv * xv, yu * yu + yv * yv, xu * yu + xv * yv
        spread = torch.hypot(sum_x - sum_y, 2 * cross)
        major = torch.sqrt(0.5 * (sum_x + sum_y + spread)).clamp_min(1e-12)
        minor = torch.sqrt((0.5 * (sum_x + sum_y - spread)).clamp_min(0))
        size = torch.maximum(minor, major / _LONGEST)
        place, texels = uv * look.scale, size * look.scale
        level = torch.log2(texels.clamp_min(1.0))
        if taps == 1:
            grey = self._atlas.sample(look.texture, place, level)
        else:
            angle = 0.5 * torch.atan2(2 * cross, sum_x - sum_y)
            axis = torch.stack([torch.cos(angle), torch.sin(angle)]) * (major * look.scale)
            offsets = [(k + 0.5) / taps - 0.5 for k in range(taps)]
            grey = sum((self._atlas.sample(look.texture, place + o * axis, level) for o in offsets), 0 * level) / taps
        deviation = look.contrast * (grey - 0.5)
        second = (look.second[3] != 0).nonzero().squeeze(1)
        if len(second):
            corner, (scale, contrast) = look.second[:, second].split(2)
            level = torch.log2((size[second] * scale).clamp_min(1.0))
            other = self._atlas.sample(corner, uv[:, second] * scale + 137.0, level)
            deviation = deviation.index_add(0, second, contrast * (other - 0.5))
        return _albedo_of(look.brightness + deviation), texels

    def _tilted(self, look: _Look, uv: Tensor, texels: Tensor, normal: Tensor) -> Tensor:
        """Normals (3, N) tilted by the slope of the first texture, as a wet, uneven surface has them."""
        step = texels.clamp_min(2.0)
        level = torch.log2(step)
        place = uv * look.scale
        here = self._atlas.sample(look.texture, place, level)
        for axis, edge in ((0, look.point[3:6]), (1, look.point[6:9])):
            moved = place.clone()
            moved[axis] += step
            slope = (self._atlas.sample(look.texture, moved, level) - here) * look.bump
            normal = normal - slope * _unit(edge)
        return _unit(normal)


def _between(columns: Tensor, fraction: Tensor) -> Tensor:
    """Value at the origin plus the fractions of its changes along either edge, (k, N) from (3 k, N)."""
    size = len(columns) // 3
    start, along_u, along_v = columns.split(size)
    return torch.addcmul(torch.addcmul(start, along_u, fraction[0]), along_v, fraction[1])


def _albedo_of(value: Tensor) -> Tensor:
    """Soft knees in place of clipping, which would lose the texture of the dark and the bright parts."""
    dark = _KNEE * torch.exp(((value - _KNEE) / _KNEE).clamp_max(0))
    bright = _KNEE * torch.exp(((1 - _KNEE - value) / _KNEE).clamp_max(0))
    return value.clamp(_KNEE, 1 - _KNEE) + (dark - _KNEE) - (bright - _KNEE)


def _dot(first: Tensor, second: Tensor) -> Tensor:
    return (first * second).sum(dim=0)


def _unit(vectors: Tensor) -> Tensor:
    return vectors * torch.rsqrt(_dot(vectors, vectors).clamp_min(_TINY))
