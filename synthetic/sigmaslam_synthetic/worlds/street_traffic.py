"""Cars and trucks on the road of a street."""

import numpy as np
from scipy.spatial.transform import Rotation

from sigmaslam.geometry.se3 import rigid_motion
from sigmaslam_synthetic.motion.paths import Path, noise
from sigmaslam_synthetic.scene import Body
from sigmaslam_synthetic.worlds.episode import Wish
from sigmaslam_synthetic.worlds.palette import Palette
from sigmaslam_synthetic.worlds.part_models import Model, bisect, covered_share, knot_times, ride
from sigmaslam_synthetic.worlds.street_furniture import car, person, truck, van
from sigmaslam_synthetic.worlds.street_road import Road

_SMALL = 0.12  # share up to which cars come and go besides


def add_traffic(rng: np.random.Generator, wish: Wish, path: Path, road: Road, palette: Palette) -> list[Body]:
    """Bodies on the move that cover about the wished share of the view, on average.

    One drives ahead and, for a large share, one in the other lane; for a small share others come towards the camera.

    Args:
        wish: what is asked for.
        path: of the camera.
        road: they drive on.
    """
    if wish.movers <= 0:
        return []
    if wish.motion == "rotation":
        return _rounding(rng, wish, path, road, palette)
    times = knot_times(wish.duration)
    camera = path.poses(times)
    s = road.arc_of(camera[:, :3, 3])
    chosen = np.unique(np.linspace(0, len(times) - 1, 8).astype(int))
    bodies: list[Body] = []
    remaining_share = wish.movers
    if wish.movers < _SMALL and road.opposite and wish.motion != "loop":
        coming = [_oncoming(rng, times, s, road, palette) for _ in range(1 + int(wish.duration / 8))]
        remaining_share -= float(covered_share([(m, T[chosen]) for m, T in coming], camera[chosen]).mean())
        bodies += [body for model, T in coming for body in ride(model, times, T)]
    makers = [truck] if wish.movers > 0.16 else [van] if wish.movers > 0.07 else [car]
    if wish.motion != "loop" and (wish.movers > 0.25 or (wish.movers > 0.1 and rng.random() < 0.5)):
        makers.append(van)  # shorter: in a bend it keeps to its lane
    led = [make(rng, palette) for make in makers]
    sway = [np.exp(0.12 * noise(rng, times, 1, 0.03, 0.12)[:, 0]) for _ in led]
    aside = [0.12 * noise(rng, times, 1, 0.03, 0.15)[:, 0] for _ in led]

    def placed(gap: float) -> list[tuple[Model, np.ndarray]]:
        result = []
        for k, model in enumerate(led):
            rear = -min(part.position[0] for part in model) + 0.6
            ahead = np.maximum(gap * sway[k] * (1.0, 1.3)[k], 2.0) + rear + (0.0, 3.0)[k]
            result.append((model, _drive(road, s + ahead, aside[k] + k * road.opposite, 0.0)))
        return result

    def error(gap: float) -> float:
        chosen_poses = [(model, T[chosen]) for model, T in placed(gap)]
        return float(covered_share(chosen_poses, camera[chosen]).mean()) - max(remaining_share, 0.2 * wish.movers)

    gap = bisect(error, 2.0, 60.0)
    return bodies + [body for model, T in placed(gap) for body in ride(model, times, T)]


def _oncoming(
    rng: np.random.Generator, times: np.ndarray, s: np.ndarray, road: Road, palette: Palette
) -> tuple[Model, np.ndarray]:
    """A car in the other lane that meets the camera at a random time."""
    model = car(rng, palette) if rng.random() < 0.7 else van(rng, palette)
    meeting = rng.uniform(0.0, times[-1])
    speed = rng.uniform(6.0, 12.0)
    along = float(np.interp(meeting, times, s)) - speed * (times - meeting)
    return model, _drive(road, along, np.full(len(times), road.opposite), np.pi)


def _drive(road: Road, s: np.ndarray, left: np.ndarray, turn: float) -> np.ndarray:
    """Poses (K, 4, 4) on the road at s metres along it, that far to the left."""
    place, _ = road.at(s, left)
    # Between the axles, so that a car does not pivot in a bend.
    (rear, _), (front, _) = (road.at(s + d, left) for d in (-1.5, 1.5))
    yaw = np.unwrap(np.arctan2(*(front - rear).T[::-1]))
    slope = np.arctan2(road.smooth_ground(front) - road.smooth_ground(rear), 3.0)
    pitch = -slope if turn == 0.0 else slope
    R = Rotation.from_euler("ZY", np.stack([yaw + turn, pitch], axis=-1)).as_matrix()
    return rigid_motion(R, np.column_stack([place, road.smooth_ground(place)]))


def _rounding(rng: np.random.Generator, wish: Wish, path: Path, road: Road, palette: Palette) -> list[Body]:
    """Cars or people that go round a camera which turns on the spot, in its view."""
    times = knot_times(wish.duration)
    camera = path.poses(times)
    view = np.unwrap(np.arctan2(camera[:, 1, 2], camera[:, 0, 2]))
    chosen = np.unique(np.linspace(0, len(times) - 1, 8).astype(int))
    make = person if wish.movers < 0.12 else car if wish.movers < 0.3 else van
    models = [make(rng, palette) for _ in range(2 if make is person else 1)]
    sway = [np.exp(0.1 * noise(rng, times, 1, 0.03, 0.12)[:, 0]) for _ in models]
    aside = [0.12 * noise(rng, times, 1, 0.03, 0.12)[:, 0] + 0.5 * k for k in range(len(models))]

    def placed(radius: float) -> list[tuple[Model, np.ndarray]]:
        result = []
        for k, model in enumerate(models):
            angle = view + aside[k]
            away = np.maximum(radius * sway[k], 1.0 if make is person else 2.2)[:, None]
            place = camera[:, :2, 3] + away * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
            R = Rotation.from_euler("z", angle[:, None] + np.pi / 2).as_matrix()
            result.append((model, rigid_motion(R, np.column_stack([place, road.smooth_ground(place)]))))
        return result

    def error(radius: float) -> float:
        poses = [(model, T[chosen]) for model, T in placed(radius)]
        return float(covered_share(poses, camera[chosen]).mean()) - wish.movers

    return [body for model, T in placed(bisect(error, 1.0, 30.0)) for body in ride(model, times, T)]
