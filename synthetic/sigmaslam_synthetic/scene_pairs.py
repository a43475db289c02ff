"""Image pairs of 3D scenes: true occlusion, depth edges, moving things. A pair is a function of (seed, index)."""

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from sigmaslam.geometry.camera import CameraModel
from sigmaslam.geometry.se3 import rigid_motion
from sigmaslam_synthetic.camera.sensor import Sensor, expose, random_sensor
from sigmaslam_synthetic.presets import PRESETS
from sigmaslam_synthetic.rendering.renderer import RenderedViews, Renderer
from sigmaslam_synthetic.rendering.visibility import Eye
from sigmaslam_synthetic.truth import at_pixels, transfer
from sigmaslam_synthetic.worlds.episode import Wish
from sigmaslam_synthetic.worlds.own import SUFFIX, Generate, load_world

DOMAINS = {name: PRESETS[name].generate for name in ("room", "street", "drone", "colon", "organ")}
# Worlds that the network that ships has not learned from.
_OTHER_DOMAINS = {name: PRESETS[name].generate for name in ("tool", "rubble")}
_SCENES = 8  # neighbouring pairs come from as many scenes ...
_USES = 32  # ... each of which serves so many pairs before it is replaced; of forward motion, as it has views
_VIEWS = 8  # of a scene
_SCENES_A_BANK = 64  # share their textures
_DURATION = 8.0  # seconds of an episode
_MAX_MOVING_SHARE = 0.4
_MIN_OVERLAP = 0.15  # of a raster of points, between the views of a pair
_RASTER = 12
_BASELINES = (0.01, 0.12)  # of stereo pairs, in median depths, drawn evenly in the logarithm
_ADVANCES = (0.02, 0.35)  # of forward motion, likewise
_DRIFT, _TURN = 0.1, 1.0  # its standard deviations: of sideways motion, in advances, and of rotation, degrees
_LATER = (0.1, 0.5)  # seconds between its views
_EXPOSURE = 0.05  # standard deviation of the logarithm of their exposures' quotient


@dataclass(frozen=True, slots=True)
class ScenePair:
    """Two views of a scene, or of its moving parts a moment later.

    Attributes:
        image0, image1: (H, W) float32 in [0, 1].
        views0, views1: what either sees, one view each.
    """

    image0: np.ndarray
    image1: np.ndarray
    views0: RenderedViews
    views1: RenderedViews

    def transfer(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where points (N, 2) of image 0 lie in image 1 (N, 2), and whether they are seen there (N,) bool."""
        return _transfer(self.views0, self.views1, points)


class ScenePairs:
    """Random-access stream of pairs of rendered 3D scenes.

    Args:
        seed: of the whole stream.
        size: side of the square images in pixels.
        domains: keys of `DOMAINS`, "tool", "rubble", or Python files, see `worlds.own`; drawn alike.
        stereo: the two views are the eyes of a rectified stereo pair, through sensors of one kind.
        max_moving_share: share of the image that may move on its own in a scene.
        forward: the two views are of one camera that advances or retreats, as a car's or a drone's.
    """

    def __init__(
        self,
        seed: int,
        size: int = 224,
        domains: tuple[str, ...] = tuple(DOMAINS),
        stereo: bool = False,
        max_moving_share: float = _MAX_MOVING_SHARE,
        forward: bool = False,
    ) -> None:
        if not domains:
            raise ValueError(f"there are no domains; give one or more of {', '.join(DOMAINS)}")
        list(map(_generator, domains))  # not kept: a function of the user's file cannot be sent to another process
        if stereo and forward:
            raise ValueError("pairs are of one kind: give stereo or forward")
        self.seed, self.size, self.domains, self.stereo, self.forward = seed, size, domains, stereo, forward
        self._max_moving_share = max_moving_share
        self._uses = _VIEWS if forward else _USES
        self._kept: OrderedDict[int, list[RenderedViews]] = OrderedDict()

    def pair(self, index: int) -> ScenePair:
        """The pair of that index, the same whenever it is asked for."""
        rng = np.random.default_rng((self.seed, 1, index))
        views = self._views(self._scene_of(index))
        order = rng.permutation([(i, j) for i in range(_VIEWS) for j in range(_VIEWS) if self._go_together(i, j)])
        # Of views that hardly overlap there is little to learn; if all are so, the last ones will do.
        i, j = next(((i, j) for i, j in order if self._overlap(views[i], views[j]) >= _MIN_OVERLAP), order[-1])
        if self.forward:
            images = self._film((views[i], views[j]), rng)
        else:
            sensor = random_sensor(rng) if self.stereo else None
            images = [self._photograph(views[k], rng, sensor) for k in (i, j)]
        return ScenePair(images[0], images[1], views[i], views[j])

    def _go_together(self, i: int, j: int) -> bool:
        if self.forward:
            return i // 2 == j // 2 and i != j
        return j == i + 1 and i % 2 == 0 if self.stereo else i != j

    def _scene_of(self, index: int) -> int:
        """Scenes are replaced one after another, so that rendering takes its time evenly."""
        turn, place = divmod(index, _SCENES)
        return (turn + place * self._uses // _SCENES) // self._uses * _SCENES + place

    def _views(self, scene: int) -> list[RenderedViews]:
        if scene not in self._kept:
            with torch.inference_mode():
                self._kept[scene] = self._render(scene)
            if len(self._kept) > 2 * _SCENES:
                self._kept.popitem(last=False)
        self._kept.move_to_end(scene)
        return self._kept[scene]

    def _render(self, scene: int) -> list[RenderedViews]:
        rng = np.random.default_rng((self.seed, 0, scene))
        domain = self.domains[int(rng.integers(len(self.domains)))]
        wish = Wish(
            _DURATION,
            movers=float(rng.uniform(0.0, self._max_moving_share)) if rng.random() < 0.5 else 0.0,
            first_texture=4 * (self.seed + scene // _SCENES_A_BANK),
            textures=4,
        )
        episode = _generator(domain)(rng, wish)
        renderer = Renderer(episode.scene)
        middle = rng.uniform(1.0, _DURATION - 1.0)
        span = np.exp(rng.uniform(np.log(0.1), np.log(2.0)))
        result: list[RenderedViews] = []
        for k in range(0, _VIEWS, 2 if self.stereo or self.forward else 1):
            time = np.clip(middle + span * rng.uniform(-0.5, 0.5), 0.0, _DURATION)[None]
            T = episode.path.poses(time)
            if k:
                # From the first view's depth it is known how far aside one can step.
                T = T @ _step_aside(rng, _median_depth(result[0]))
            focal = self.size * np.exp(rng.uniform(np.log(0.6), np.log(1.3)))
            centre = (self.size - 1) / 2
            eye = Eye(CameraModel(self.size, self.size, focal, focal, centre, centre))
            result.append(renderer.render(eye, T, time))
            if self.stereo:
                baseline = _median_depth(result[0]) * np.exp(rng.uniform(*np.log(_BASELINES)))
                result.append(renderer.render(eye, T @ rigid_motion(np.eye(3), [baseline, 0.0, 0.0]), time))
            if self.forward:
                later = np.minimum(time + rng.uniform(*_LATER), _DURATION)
                result.append(renderer.render(eye, T @ _advance(rng, _median_depth(result[-1])), later))
        return result

    def _film(self, views: tuple[RenderedViews, RenderedViews], rng: np.random.Generator) -> list[np.ndarray]:
        """Images of one camera, whose exposure follows the light a little."""
        sensor = random_sensor(rng)
        exposure = rng.uniform(0.3, 0.6) / max(float(views[0].image.mean()), 1e-6)
        exposures = exposure, exposure * np.exp(_EXPOSURE * rng.standard_normal())
        return [
            _expose(view.image[0].numpy() * factor, sensor, rng, None)
            for view, factor in zip(views, exposures, strict=True)
        ]

    def _photograph(self, views: RenderedViews, rng: np.random.Generator, sensor: Sensor | None) -> np.ndarray:
        light = views.image[0].numpy()
        light = light * (rng.uniform(0.3, 0.6) / max(float(light.mean()), 1e-6))
        flow = rng.normal(0.0, 4.0, 2) if rng.random() < 0.15 else None
        return _expose(light, sensor or random_sensor(rng), rng, flow)

    def _overlap(self, views0: RenderedViews, views1: RenderedViews) -> float:
        ticks = (np.arange(_RASTER) + 0.5) * self.size / _RASTER
        raster = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
        return float(_transfer(views0, views1, raster)[1].mean())


def _generator(domain: str) -> Generate:
    known = DOMAINS | _OTHER_DOMAINS
    if domain in known:
        return known[domain]
    if domain.endswith(SUFFIX):
        return load_world(domain)
    raise ValueError(f"unknown domain {domain!r}; give one or more of {', '.join(known)}, or a Python file")


def _expose(light: np.ndarray, sensor: Sensor, rng: np.random.Generator, flow: np.ndarray | None) -> np.ndarray:
    # White is where the light of few pixels ends, so that the sensor's contrast means the same everywhere.
    return expose(np.minimum(light, 1.0), sensor, rng, flow).astype(np.float32) / np.float32(255.0)


def _transfer(views0: RenderedViews, views1: RenderedViews, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    view = torch.zeros(len(points), dtype=torch.int64)
    facet, places = at_pixels(views0, view, torch.from_numpy(points.T.astype(np.float64)))
    hit = facet >= 0
    moved = transfer(views0.sight, view[hit], facet[hit], places[:, hit], views1.sight, view[hit])
    places1, visible = np.full((len(points), 2), -1.0), np.zeros(len(points), dtype=bool)
    index = hit.numpy()
    places1[index] = np.nan_to_num(moved.pixels.T.numpy(), nan=-1.0)
    visible[index] = moved.visible.numpy()
    return places1, visible


def _median_depth(views: RenderedViews) -> float:
    return float(views.depth[torch.isfinite(views.depth)].median())


def _advance(rng: np.random.Generator, depth: float) -> np.ndarray:
    """Motion of a camera along its axis, nearly, (4, 4)."""
    step = depth * np.exp(rng.uniform(*np.log(_ADVANCES)))
    drift = _DRIFT * rng.standard_normal(2)
    turn = np.deg2rad(_TURN) * rng.standard_normal(3)
    return rigid_motion(Rotation.from_rotvec(turn).as_matrix(), step * np.array([*drift, 1.0]))


def _step_aside(rng: np.random.Generator, depth: float) -> np.ndarray:
    """A small random motion of the camera, (4, 4): mostly a turn, a roll now and then."""
    turn = np.deg2rad(6.0) * rng.standard_normal(3)
    turn[2] += np.deg2rad(rng.uniform(-40.0, 40.0)) if rng.random() < 0.4 else 0.0
    step = depth * rng.uniform(0.0, 0.08) * rng.standard_normal(3) * np.array([1.0, 0.5, 0.5])
    return rigid_motion(Rotation.from_rotvec(turn).as_matrix(), step)
