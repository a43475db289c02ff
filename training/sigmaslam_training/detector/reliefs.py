"""Facades with relief and planes, drawn on the device: rays marched through a field of heights."""

import math

import torch
from torch import Tensor
from torch.nn import functional

from sigmaslam_training.detector.view_store import Views

_FIELD = 512  # texels a side, from -1 to 1
_STEPS, _HALVINGS, _SHADOW_STEPS = 28, 5, 12
_PLANES = 0.4  # share of scenes without relief
_FINER = 2  # rays a pixel, along either side


class Reliefs:
    """Random scenes of a field of heights with a texture, seen from around.

    Args:
        size: side of the images.
        views: of a scene.
        device: where they are drawn.
        generator: of that device.
    """

    def __init__(self, size: int, views: int, device: torch.device, generator: torch.Generator) -> None:
        self._size, self._count, self._device, self._generator = size, views, device, generator

    def scenes(self, bank: Tensor, count: int) -> list[Views]:
        """So many scenes; `bank` (T, S, S) uint8 textures, from which colours and heights come."""
        textures = self._field(bank, count)
        relief = self._heights(bank, count)
        flat = self._uniform(count) < _PLANES
        cameras, T, nominal = self._cameras(count, flat)
        depth_share = (math.log(0.06) + self._uniform(count) * math.log(0.5 / 0.06)).exp()
        height = torch.where(flat, 0.0, depth_share * nominal)
        light, depth = self._draw(textures, relief * height.view(-1, 1, 1, 1), height, cameras, T)
        return [Views(light[k], depth[k], cameras[k], T[k]) for k in range(count)]

    def _uniform(self, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=self._generator, device=self._device)

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self._generator, device=self._device)

    def _pick(self, bank: Tensor, count: int) -> Tensor:
        """Textures (count, 1, F, F) in [0, 1], turned, mirrored, negative and of another scale at random."""
        index = torch.randint(len(bank), (count,), generator=self._generator, device=self._device)
        chosen = bank[index].float().unsqueeze(1) / 255.0
        chosen = functional.interpolate(chosen, size=(_FIELD, _FIELD), mode="bilinear", align_corners=False)
        angle, zoom = self._uniform(count, high=2 * math.pi), self._uniform(count, low=0.6, high=1.5)
        rows = (
            torch.stack([angle.cos(), -angle.sin(), self._normal(count)], dim=1),
            torch.stack([angle.sin(), angle.cos(), self._normal(count)], dim=1),
        )
        grid = functional.affine_grid(torch.stack(rows, dim=1) * zoom.view(-1, 1, 1), list(chosen.shape), False)
        chosen = functional.grid_sample(chosen, grid, align_corners=False, padding_mode="reflection")
        negative = (self._uniform(count) < 0.5).view(-1, 1, 1, 1)
        return torch.where(negative, 1.0 - chosen, chosen)

    def _field(self, bank: Tensor, count: int) -> Tensor:
        """Albedo (count, 1, F, F)."""
        first, second, mask = (self._pick(bank, count) for _ in range(3))
        share = ((mask - self._uniform(count, 1, 1, 1, low=0.2, high=1.2)) * 20.0).sigmoid()
        mixed = torch.lerp(first, second, share)
        mean = mixed.mean(dim=(2, 3), keepdim=True)
        contrast = self._uniform(count, 1, 1, 1, low=0.3, high=1.2)
        stone = (_even(self._rough(count)) - 0.5) * self._uniform(count, 1, 1, 1, high=0.8)
        return (mean + contrast * (mixed - mean) + stone).clamp(0.0, 1.0) * 0.85 + 0.05

    def _rough(self, count: int) -> Tensor:
        """Noise of all scales (count, 1, F, F)."""
        rough = torch.zeros((count, 1, _FIELD, _FIELD), device=self._device)
        slope = self._uniform(count, 1, 1, 1, low=0.3, high=1.6)
        for octave in range(7):
            side = 4 * 2**octave
            noise = functional.interpolate(self._normal(count, 1, side, side), (_FIELD, _FIELD), mode="bicubic")
            rough += noise * 2.0 ** (-slope * octave)
        return rough

    def _heights(self, bank: Tensor, count: int) -> Tensor:
        """(count, 1, F, F) in [0, 1]: plates, engravings, domes, columns and rough ground, mixed."""
        plates = self._pick(bank, count)
        levels = self._uniform(count, 1, 1, 1, low=2.0, high=6.0).round()
        stepped = (plates * levels).round() / levels
        plates = torch.where(self._uniform(count, 1, 1, 1) < 0.5, stepped, plates)
        rough = self._rough(count)
        axis = torch.linspace(-1.0, 1.0, _FIELD, device=self._device)
        y, x = axis.view(1, -1, 1), axis.view(1, 1, -1)
        domes = torch.zeros_like(plates)
        for _ in range(10):
            u, v = self._uniform(count, 1, 1, low=-1.0), self._uniform(count, 1, 1, low=-1.0)
            radius = self._uniform(count, 1, 1, low=0.05, high=0.35)
            narrow = torch.where(self._uniform(count, 1, 1) < 0.4, 0.0, 1.0)  # 0: a column
            distance = ((x - u) ** 2 + narrow * (y - v) ** 2) / radius**2
            domes = torch.maximum(domes, (1.0 - distance).clamp_min(0.0).sqrt().unsqueeze(1) * radius.unsqueeze(1) * 3)
        boxes = torch.zeros_like(plates)
        for _ in range(12):
            u, v = self._uniform(count, 1, 1, low=-1.0), self._uniform(count, 1, 1, low=-1.0)
            a, b = self._uniform(count, 1, 1, low=0.03, high=0.4), self._uniform(count, 1, 1, low=0.03, high=0.4)
            inside = ((x - u).abs() < a) & ((y - v).abs() < b)
            boxes = torch.where(inside.unsqueeze(1), self._uniform(count, 1, 1, 1), boxes)
        weights = self._uniform(count, 4) * (self._uniform(count, 4) < 0.6)
        total = sum(
            weights[:, k].view(-1, 1, 1, 1) * each
            for k, each in enumerate((_even(plates), 0.7 * _even(rough), _even(domes), _even(boxes)))
        )
        # Some reliefs are worn.
        blurred = functional.avg_pool2d(total, 9, 1, 4, count_include_pad=False)
        total = torch.where(self._uniform(count, 1, 1, 1) < 0.4, blurred, total)
        return _even(total + self._uniform(count, 1, 1, 1, low=0.02, high=0.3) * _even(self._rough(count)))

    def _cameras(self, count: int, flat: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cameras (count, V, 3), poses (count, V, 4, 4) float64, and the distance of the scene (count,)."""
        size, views = self._size, self._count
        texels = (math.log(0.55) + self._uniform(count) * math.log(1.2 / 0.55)).exp()
        focal = size * (math.log(0.6) + self._uniform(count) * math.log(1.6 / 0.6)).exp()
        nominal = texels * (2.0 / _FIELD) * focal
        wild = (self._uniform(count) < torch.where(flat, 0.7, 0.2)).view(-1, 1)
        orbit = torch.where(wild, 0.5, 1.0)
        spread = self._uniform(count, 1, low=0.2, high=1.0)
        yaw = math.radians(40.0) * orbit * spread * self._uniform(count, views, low=-1.0)
        pitch = math.radians(25.0) * orbit * spread * self._uniform(count, views, low=-1.0)
        roll = torch.where(
            wild,
            math.radians(50.0) * self._uniform(count, views, low=-1.0),
            math.radians(6.0) * self._normal(count, views),
        )
        distance = nominal.view(-1, 1) * (torch.where(wild, 0.45, 0.25) * self._uniform(count, views, low=-1.0)).exp()
        aim = self._uniform(count, 1, 2, low=-0.5, high=0.5) + 0.1 * nominal.view(-1, 1, 1) * self._normal(
            count, views, 2
        )
        # The surface faces -z; the camera looks along +z.
        R = _rotation(1, yaw) @ _rotation(0, pitch) @ _rotation(2, roll)
        T = torch.eye(4, dtype=torch.float64, device=self._device).repeat(count, views, 1, 1)
        T[..., :3, :3] = R
        T[..., :3, 3] = -distance.unsqueeze(-1).double() * R[..., :, 2]
        T[..., :2, 3] += aim
        zoom = (0.15 * self._normal(count, views)).exp()
        centre = torch.full_like(zoom, (size - 1) / 2)
        return torch.stack([focal.view(-1, 1) * zoom, centre, centre], dim=-1), T, nominal

    def _draw(self, albedo: Tensor, relief: Tensor, height: Tensor, camera: Tensor, T: Tensor) -> tuple[Tensor, Tensor]:
        """Light and depth (G, V, 1, S, S)."""
        count, views = camera.shape[:2]
        side = _FINER * self._size
        ticks = (torch.arange(side, device=self._device) + 0.5) / _FINER - 0.5
        focal, centre = camera[..., 0].view(count, views, 1, 1), camera[..., 1].view(count, views, 1, 1)
        x = ((ticks.view(1, 1, 1, -1) - centre) / focal).expand(-1, -1, side, -1)
        y = ((ticks.view(1, 1, -1, 1) - centre) / focal).expand(-1, -1, -1, side)
        R, o = T[..., :3, :3].float(), T[..., :3, 3].float()
        rays = [
            R[..., k, 0, None, None] * x + R[..., k, 1, None, None] * y + R[..., k, 2, None, None] for k in range(3)
        ]
        ahead = rays[2] > 0.15
        dz = rays[2].clamp_min(0.15)
        oz = o[..., 2, None, None]
        near = ((-height.view(-1, 1, 1, 1) - oz) / dz).clamp_min(1e-3)
        far = -oz / dz

        def at(field: Tensor, t: Tensor) -> Tensor:
            grid = torch.stack([o[..., k, None, None] + rays[k] * t for k in range(2)], dim=-1)
            return _look_up(field, grid)

        above, below, found = near, far, torch.zeros_like(ahead)
        for step in range(1, _STEPS + 1):
            t = near + (far - near) * (step / _STEPS)
            under = oz + dz * t >= -at(relief, t)
            below = torch.where(under & ~found, t, below)
            above = torch.where(under | found, above, t)
            found |= under
        for _ in range(_HALVINGS):
            t = 0.5 * (above + below)
            under = oz + dz * t >= -at(relief, t)
            below, above = torch.where(under, t, below), torch.where(under, above, t)
        t = 0.5 * (above + below)
        # Depth is along the camera's axis, and so is t: rays have length 1 there.
        place = torch.stack([o[..., k, None, None] + rays[k] * t for k in range(2)], dim=-1)
        step = 2.0 / _FIELD
        slope_x = (relief.roll(-1, 3) - relief.roll(1, 3)) / (2 * step)
        slope_y = (relief.roll(-1, 2) - relief.roll(1, 2)) / (2 * step)
        hx, hy = _look_up(slope_x, place).clamp(-3, 3), _look_up(slope_y, place).clamp(-3, 3)
        # The sun moves between the views of some scenes.
        moved = (self._uniform(count, 1) < 0.3).float()
        azimuth = self._uniform(count, 1, high=2 * math.pi) + moved * self._normal(count, views)
        elevation = self._uniform(count, 1, low=0.35, high=1.4).expand(-1, views)
        sun = [azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin()]
        sun = [each[..., None, None] for each in sun]
        lambert = (-hx * sun[0] - hy * sun[1] + sun[2]) / (1.0 + hx**2 + hy**2).sqrt()
        strength = self._uniform(count, 1, 1, 1, high=1.8)
        own = _look_up(relief, place)
        lit = torch.ones_like(own)
        if float(self._uniform(1)) < 0.6:
            reach = (height.view(-1, 1, 1, 1) - own).clamp_min(0.0) / sun[2]
            for k in range(1, _SHADOW_STEPS + 1):
                way = reach * (k / _SHADOW_STEPS)
                along = torch.stack([place[..., 0] + sun[0] * way, place[..., 1] + sun[1] * way], dim=-1)
                lit = torch.where(_look_up(relief, along) > own + sun[2] * way + 0.004, 0.0, lit)
        ambient = self._uniform(count, 1, 1, 1, low=0.15, high=0.6)
        light = _look_up(albedo, place) * (ambient + strength * lambert.clamp_min(0.0) * lit)
        light = torch.where(ahead, light, 0.3)
        light = functional.avg_pool2d(light, _FINER)
        parts = torch.where(ahead, 1.0 / t.clamp_min(1e-3), 0.0)
        mean, most = functional.avg_pool2d(parts, _FINER), functional.max_pool2d(parts, _FINER)
        least = -functional.max_pool2d(-parts, _FINER)
        inverse = torch.where(least > 0.97 * most, mean, most)
        return light.unsqueeze(2), (1.0 / inverse).unsqueeze(2)


def _look_up(field: Tensor, places: Tensor) -> Tensor:
    """Values (G, V, R, R) of a field (G, 1, F, F) at places (G, V, R, R, 2) from -1 to 1, mirrored beyond."""
    count, views, rows, columns = places.shape[:4]
    grid = places.reshape(count, views * rows, columns, 2)
    values = functional.grid_sample(field, grid, align_corners=False, padding_mode="reflection")
    return values.view(count, views, rows, columns)


def _even(field: Tensor) -> Tensor:
    low, high = field.amin(dim=(2, 3), keepdim=True), field.amax(dim=(2, 3), keepdim=True)
    return (field - low) / (high - low).clamp_min(1e-6)


def _rotation(axis: int, angle: Tensor) -> Tensor:
    """(..., 3, 3) float64."""
    c, s = angle.double().cos(), angle.double().sin()
    R = torch.zeros(*angle.shape, 3, 3, dtype=torch.float64, device=angle.device)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R[..., axis, axis] = 1.0
    R[..., i, i], R[..., j, j] = c, c
    R[..., i, j], R[..., j, i] = -s, s
    return R
