"""Random scenes: a furnished room, a street with a bend. World axes: z up, the floor or ground at z = 0."""

from collections.abc import Callable

import cv2
import numpy as np

from sigmaslam.synthetic.scene import Rectangle, Scene

ROOM_SIZE = (8.0, 5.0, 3.0)  # metres along x, y, z; the room is centred on the z axis
STREET_BEND = (18.0, 30.0, np.deg2rad(35.0))  # where it begins, how long it is, by how much it turns
UP = np.array([0.0, 0.0, 1.0])

Painter = Callable[[float, float], np.ndarray]  # (width, height) in metres -> texture


def room_scene(rng: np.random.Generator) -> Scene:
    """A textured room of 8 x 5 x 3 m with 6 to 12 boxes and panels, and two low tables.

    The middle, |x| < 2 m and |y| < 1 m above 0.8 m, stays free for the camera.
    """
    scale = 200.0
    pool = _texture_pool(rng)

    def paint(width: float, height: float) -> np.ndarray:
        return _surface(pool, rng, width, height, scale)

    lx, ly, lz = ROOM_SIZE
    x, y = np.eye(3)[:2]
    rectangles = [
        _panel(np.array([0, ly / 2, lz / 2]), x, -UP, lx, lz, paint, scale),
        _panel(np.array([0, -ly / 2, lz / 2]), -x, -UP, lx, lz, paint, scale),
        _panel(np.array([lx / 2, 0, lz / 2]), -y, -UP, ly, lz, paint, scale),
        _panel(np.array([-lx / 2, 0, lz / 2]), y, -UP, ly, lz, paint, scale),
        _panel(np.array([0, 0, 0]), x, -y, lx, ly, paint, scale),
        _panel(np.array([0, 0, lz]), x, y, lx, ly, paint, scale),
    ]
    count = int(rng.integers(6, 13))
    for k in range(count):
        yaw = rng.uniform(-0.5, 0.5)
        # Round the room in steps, so that every view has something in front of a wall.
        angle = 2 * np.pi * (k + rng.uniform(-0.3, 0.3)) / count
        direction = np.array([np.cos(angle), np.sin(angle), 0.0])
        to_wall = 1.0 / np.abs(direction[:2] / (lx / 2, ly / 2)).max()  # metres from the middle
        place = direction * to_wall * rng.uniform(0.72, 0.86)
        if rng.random() < 0.25:
            place[2] = rng.uniform(1.2, 1.9)
            along = np.array([-direction[1], direction[0], 0.0])
            along = np.cos(yaw) * along + np.sin(yaw) * direction
            width, height = rng.uniform(0.5, 1.0, 2)
            rectangles.append(_panel(place, -along, -UP, width, height, paint, scale))
        else:
            size = np.array([rng.uniform(0.4, 0.9), rng.uniform(0.4, 0.7), rng.uniform(0.5, 2.1)])
            place[2] = size[2] / 2
            rectangles += _box(place, size, yaw, paint, scale)
    for _ in range(2):  # low tables in the middle
        size = np.array([rng.uniform(0.5, 1.0), rng.uniform(0.5, 0.8), rng.uniform(0.35, 0.7)])
        place = np.array([rng.uniform(-2, 2), rng.uniform(-0.8, 0.8), size[2] / 2])
        rectangles += _box(place, size, rng.uniform(0, np.pi), paint, scale)
    return Scene(rectangles)


def street_scene(rng: np.random.Generator, length: float = 60.0) -> Scene:
    """A street along `street_line`: ground, lane marks, facades on both sides, poles and parked boxes.

    Args:
        rng: source of all randomness.
        length: metres of street; a facade closes its end.
    """
    scale = 50.0
    pool = _texture_pool(rng)

    def plain(width: float, height: float) -> np.ndarray:
        return _surface(pool, rng, width, height, scale)

    def facade(width: float, height: float) -> np.ndarray:
        return _with_windows(plain(width, height), rng, scale)

    def asphalt(width: float, height: float) -> np.ndarray:
        return 0.18 + 0.35 * _surface(pool, rng, min(width, 40.0), min(height, 40.0), scale)

    def paint_mark(width: float, height: float) -> np.ndarray:
        return 0.55 + 0.45 * plain(width, height)

    middle, _ = street_line(np.array(length / 2))
    side = 2 * length + 60.0
    x, y = np.eye(3)[:2]
    rectangles = [_panel(np.append(middle, 0.0), x, -y, side, side, asphalt, scale)]
    for s in np.arange(0.0, length, 5.0):
        place, ahead, _ = _street_frame(float(s), 0.0)
        mark = np.cross(ahead, UP)
        rectangles.append(_panel(place + 0.004 * UP, mark, ahead, 0.15, 2.2, paint_mark, scale))
    for hand in (-1.0, 1.0):
        s = -12.0
        while s < length + 5.0:
            width = rng.uniform(6.0, 11.0)
            place, _, yaw = _street_frame(s + width / 2, hand * rng.uniform(11.5, 12.5))
            size = np.array([width + 0.4, 8.0, rng.uniform(6.0, 14.0)])
            rectangles += _box(place + size[2] / 2 * UP, size, yaw, facade, scale)
            s += width
        s = rng.uniform(2.0, 6.0)
        while s < length:
            if rng.random() < 0.6:
                place, _, yaw = _street_frame(s, hand * rng.uniform(4.4, 5.0))
                size = np.array([rng.uniform(3.2, 4.8), rng.uniform(1.6, 1.9), rng.uniform(1.3, 2.2)])
                rectangles += _box(place + size[2] / 2 * UP, size, yaw, plain, scale)
            place, _, yaw = _street_frame(s + 3.5, hand * rng.uniform(6.2, 7.0))
            size = np.array([0.2, 0.2, rng.uniform(3.0, 6.0)])
            rectangles += _box(place + size[2] / 2 * UP, size, yaw, plain, scale)
            s += rng.uniform(6.5, 10.0)
    place, _, yaw = _street_frame(length + 12.0, 0.0)
    rectangles += _box(place + 6.0 * UP, np.array([8.0, 30.0, 12.0]), yaw, facade, scale)
    return Scene(rectangles, sky=0.86)


def street_line(arc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The street's centre line: straight along x, one bend to the left, straight again.

    Args:
        arc: (...,) metres along the line; negative before the start.
    Returns:
        (..., 2) position and (...,) heading, radians from x towards y.
    """
    begin, extent, turn = STREET_BEND

    def heading(s: np.ndarray) -> np.ndarray:
        share = np.clip((s - begin) / extent, 0.0, 1.0)
        return np.asarray(turn * share**2 * (3.0 - 2.0 * share))

    arc = np.asarray(arc, dtype=np.float64)
    grid = np.linspace(begin, begin + extent, 3001)
    steps = np.diff(grid)[:, None] * _direction(heading((grid[1:] + grid[:-1]) / 2))
    bend = np.concatenate([[[begin, 0.0]], np.array([begin, 0.0]) + np.cumsum(steps, axis=0)])
    inside = np.stack([np.interp(arc, grid, bend[:, 0]), np.interp(arc, grid, bend[:, 1])], axis=-1)
    before = np.minimum(arc - begin, 0.0)[..., None] * np.array([1.0, 0.0])
    beyond = np.maximum(arc - begin - extent, 0.0)[..., None] * _direction(np.array(turn))
    return inside + before + beyond, heading(arc)


def _direction(heading: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(heading), np.sin(heading)], axis=-1)


def _street_frame(arc: float, left: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Ground point `left` metres left of the centre line, the direction of travel, and its heading."""
    place, heading = street_line(np.array(arc))
    ahead = np.append(_direction(heading), 0.0)
    return np.append(place, 0.0) + left * np.cross(UP, ahead), ahead, float(heading)


def _panel(
    centre: np.ndarray,
    right: np.ndarray,
    down: np.ndarray,
    width: float,
    height: float,
    paint: Painter,
    scale: float,
) -> Rectangle:
    edge_u, edge_v = width * right, height * down
    return Rectangle(centre - edge_u / 2 - edge_v / 2, edge_u, edge_v, paint(width, height), scale)


def _box(centre: np.ndarray, size: np.ndarray, yaw: float, paint: Painter, scale: float) -> list[Rectangle]:
    """Four sides and a top; the bottom is left out, boxes stand on the ground."""
    ahead = np.append(_direction(np.array(yaw)), 0.0)
    left = np.cross(UP, ahead)
    lx, ly, lz = size
    return [
        _panel(centre + lx / 2 * ahead, left, -UP, ly, lz, paint, scale),
        _panel(centre - lx / 2 * ahead, -left, -UP, ly, lz, paint, scale),
        _panel(centre + ly / 2 * left, -ahead, -UP, lx, lz, paint, scale),
        _panel(centre - ly / 2 * left, ahead, -UP, lx, lz, paint, scale),
        _panel(centre + lz / 2 * UP, ahead, -left, lx, ly, paint, scale),
    ]


def _texture_pool(rng: np.random.Generator, count: int = 6) -> list[np.ndarray]:
    """Dead-leaves images from which all surfaces of a scene are cut."""
    from sigmaslam.synthetic.textures import dead_leaves

    return [dead_leaves((512, 512), rng).astype(np.float32) / 255.0 for _ in range(count)]


def _surface(pool: list[np.ndarray], rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
    """A texture of its own for a surface of width x height metres: coarse and fine leaves, uneven light."""
    shape = (int(np.ceil(height * scale)), int(np.ceil(width * scale)))
    weight = rng.uniform(0.35, 0.75)
    grey = weight * _cut(pool, rng, shape, rng.uniform(3.0, 5.0))
    grey += (1.0 - weight) * _cut(pool, rng, shape, rng.uniform(1.2, 2.2))
    grey = (grey - grey.mean()) / max(float(grey.std()), 0.05)
    grey = rng.uniform(0.38, 0.68) + rng.uniform(0.15, 0.27) * grey
    light = rng.uniform(0.7, 1.1, (3, 3)).astype(np.float32)
    grey *= cv2.resize(light, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    # A soft knee in place of clipping keeps texture in the dark and the bright parts.
    return np.asarray(0.5 + 0.48 * np.tanh((grey - 0.5) / 0.48), dtype=np.float32)


def _cut(pool: list[np.ndarray], rng: np.random.Generator, shape: tuple[int, int], zoom: float) -> np.ndarray:
    """A magnified piece of one of the pool's images, or of several side by side where one is too small."""
    rows, columns = (int(np.ceil(extent / zoom)) for extent in shape)
    piece = np.empty((rows, columns), dtype=np.float32)
    side = pool[0].shape[0]
    for top in range(0, rows, side):
        for left in range(0, columns, side):
            part = piece[top : top + side, left : left + side]
            source = np.rot90(pool[rng.integers(len(pool))], int(rng.integers(4)))
            if rng.random() < 0.5:
                source = source[::-1]
            y, x = (int(rng.integers(side - extent + 1)) for extent in part.shape)
            part[:] = source[y : y + part.shape[0], x : x + part.shape[1]]
    return np.asarray(cv2.resize(piece, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC))


def _with_windows(wall: np.ndarray, rng: np.random.Generator, scale: float) -> np.ndarray:
    """A copy of a wall's texture with rows of framed windows."""
    wall = wall.copy()
    width, height, frame = rng.uniform(0.8, 1.4), rng.uniform(1.2, 1.9), 0.1
    step_u, step_v = width + rng.uniform(0.6, 1.4), height + rng.uniform(1.0, 1.6)
    trim = rng.choice([0.2, 0.85])
    for top in np.arange(0.8, wall.shape[0] / scale - height - 0.3, step_v):
        for left in np.arange(0.5, wall.shape[1] / scale - width - 0.3, step_u):
            y0, x0 = int(top * scale), int(left * scale)
            y1, x1, edge = y0 + int(height * scale), x0 + int(width * scale), int(frame * scale)
            wall[y0:y1, x0:x1] = trim
            bar = (x0 + x1) // 2
            for a, b in ((x0 + edge, bar - edge // 2), (bar + edge // 2, x1 - edge)):
                pane = wall[y0 + edge : y1 - edge, a:b]
                shine = np.linspace(rng.uniform(0.05, 0.5), rng.uniform(0.05, 0.35), pane.shape[0])
                pane[:] = shine[:, None] + 0.04 * rng.standard_normal()
    return np.asarray(np.clip(wall, 0.0, 1.0))
