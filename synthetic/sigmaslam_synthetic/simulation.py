"""All that a rendered sequence is made of; any of its frames can be made alone, again, and in any process."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import torch

from sigmaslam.errors import InputError
from sigmaslam_synthetic.camera.rig import Miscalibration, Rig
from sigmaslam_synthetic.camera.sensor import Sensor, expose, exposure_gains
from sigmaslam_synthetic.inertial import SimulatedInertial, simulate_inertial
from sigmaslam_synthetic.motion.paths import Path
from sigmaslam_synthetic.presets import EXPOSURES, PRESETS, SENSORS, Layout
from sigmaslam_synthetic.render_choices import CARRIED, MOTIONS, ROLLING
from sigmaslam_synthetic.rendering.renderer import RenderedViews, Renderer
from sigmaslam_synthetic.rendering.visibility import Eye
from sigmaslam_synthetic.scene import Scene
from sigmaslam_synthetic.truth import flow
from sigmaslam_synthetic.worlds.episode import Wish
from sigmaslam_synthetic.worlds.own import check_world, load_world

_BRIGHTNESS = 0.48  # mean of the linear image that the exposure aims at
_METERED = 5  # frames that are looked at for it
# Streams of random numbers of one seed: what one draws does not depend on the others.
_WORLD, _RIG, _ERRORS, _GAINS, _NOISE, _INERTIAL = range(6)
# Samples a second that an inertial sensor may have.
_RATES = (20.0, 10_000.0)


@dataclass(frozen=True, slots=True)
class Recipe:
    """What is asked for; the same recipe gives the same bytes.

    Attributes:
        preset: a key of `PRESETS`.
        frames: number of stereo pairs.
        seed: of all randomness.
        motion: one of `MOTIONS`.
        movers: share of the image that moves on its own, 0 to 0.5.
        sensor: a key of `SENSORS`.
        disparity_offset: pixels by which disparities exceed what the written calibration says.
        rotation_error: degrees by which the right camera is turned against its calibration, about a random axis.
        width, height: pixels; the preset's unless given.
        profile: KITTI poses file that a drive follows.
        world: Python file that makes the world, see `worlds.own`, in place of the preset's, whose camera it is seen by.
        imu: samples a second of an inertial sensor on the camera; None: there is none.
    """

    preset: str
    frames: int
    seed: int = 0
    motion: str = "normal"
    movers: float = 0.0
    sensor: str = "normal"
    disparity_offset: float = 0.0
    rotation_error: float = 0.0
    width: int | None = None
    height: int | None = None
    profile: str | None = None
    world: str | None = None
    imu: float | None = None

    @property
    def name(self) -> str:
        """Of the sequence among others that differ in world and seed."""
        return f"{self.preset}{self.seed}"

    def check(self) -> None:
        """Raises InputError where a value is out of range."""
        for name, value, choices in (
            ("preset", self.preset, PRESETS),
            ("motion", self.motion, MOTIONS),
            ("sensor", self.sensor, SENSORS),
        ):
            if value not in choices:
                raise InputError(f"{name} {value!r} is unknown; choose one of {', '.join(choices)}")
        if self.frames < 1:
            raise InputError(f"frames is {self.frames}; give at least 1")
        if self.seed < 0:
            raise InputError(f"seed is {self.seed}; give a number from 0 up")
        if not 0 <= self.movers <= 0.5:
            raise InputError(f"movers is {self.movers}; give a share of the image from 0 to 0.5")
        if min(self.width or 16, self.height or 16) < 16:
            raise InputError(f"the image size {self.width}x{self.height} is too small; give at least 16x16")
        if self.motion == "shaken" and self.preset not in CARRIED:
            raise InputError(
                f"the motion shaken goes with {', '.join(CARRIED)}, whose camera is carried by hand or "
                f"flies, not with {self.preset}"
            )
        if self.motion == "planar" and self.preset not in ROLLING:
            raise InputError(f"the motion planar goes with {', '.join(ROLLING)}, where there is a level floor")
        if self.profile is not None and self.preset != "street":
            raise InputError(f"a profile of real motion goes with the preset street, not with {self.preset}")
        if self.imu is not None and not _RATES[0] <= self.imu <= _RATES[1]:
            raise InputError(f"imu is {self.imu}; give {_RATES[0]:g} to {_RATES[1]:g} samples a second, as 200")
        if self.world is not None:
            check_world(self.world)


@dataclass(frozen=True, slots=True)
class Simulation:
    """A world, the way through it, the cameras and their faults.

    Attributes:
        scene: all there is to see.
        path: of the left camera.
        rig: the stereo camera.
        fps: pairs per second.
        frames: number of pairs.
        layout: of the folder to write.
        sensor: of both cameras, gain at the exposure that was metered.
        gains: (frames, 2) factors on the gain, left and right.
        seed: of the noise.
    """

    scene: Scene
    path: Path
    rig: Rig
    fps: float
    frames: int
    layout: Layout
    sensor: Sensor
    gains: np.ndarray
    seed: int

    @property
    def times(self) -> np.ndarray:
        """Seconds of each frame, (frames,)."""
        return np.arange(self.frames) / self.fps

    def to_json(self) -> dict[str, Any]:
        """All of it as JSON can hold it."""
        return {
            "fps": self.fps,
            "frames": self.frames,
            "layout": self.layout,
            "seed": self.seed,
            "rig": self.rig.to_json(),
            "sensor": asdict(self.sensor),
            "gains": self.gains.tolist(),
            "path": self.path.to_json(),
            "scene": self.scene.to_json(),
        }

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> "Simulation":
        """The simulation that `to_json` wrote."""
        return cls(
            Scene.from_json(content["scene"]),
            Path.from_json(content["path"]),
            Rig.from_json(content["rig"]),
            content["fps"],
            content["frames"],
            content["layout"],
            Sensor(**content["sensor"]),
            np.array(content["gains"]),
            content["seed"],
        )


@dataclass(frozen=True, slots=True)
class Frame:
    """A stereo pair with its truth.

    Attributes:
        left, right: (H, W) uint8 images.
        depth: (H, W) float32 z in the left camera, metres; inf where there is nothing.
        body: (H, W) int16 instance id in the left image, index into `Scene.bodies`; -1 where there is nothing.
        flow: (H, W, 2) float32 displacement from the left image to the next left image, pixels; NaN where none is.
        flow_visible: (H, W) bool, the point is seen there too.
        stereo: (H, W, 2) float32 displacement from the left to the right image, pixels, faults of the pair included.
        stereo_visible: (H, W) bool, the point is seen there too.
    """

    left: np.ndarray
    right: np.ndarray
    depth: np.ndarray
    body: np.ndarray
    flow: np.ndarray
    flow_visible: np.ndarray
    stereo: np.ndarray
    stereo_visible: np.ndarray


def simulate(recipe: Recipe) -> Simulation:
    """Makes the world of a recipe and meters its exposure.

    Raises:
        InputError: the recipe is wrong, or its profile cannot be read.
    """
    recipe.check()
    preset = PRESETS[recipe.preset]
    rngs = [np.random.default_rng((recipe.seed, stream)) for stream in range(_NOISE)]
    wish = Wish(
        # The last frame's flow needs one more pose.
        duration=(recipe.frames + 1) / preset.fps,
        motion=recipe.motion,
        movers=recipe.movers,
        profile=None if recipe.profile is None else FilePath(recipe.profile),
        first_texture=16 * recipe.seed,
        textures=8,
    )
    generate = preset.generate if recipe.world is None else load_world(recipe.world)
    episode = generate(rngs[_WORLD], wish)
    start, end = episode.path.start, episode.path.end
    if len(episode.path.times) > 1 and (start > 0 or end < wish.duration - 1e-9):
        name = recipe.world or recipe.preset
        raise InputError(f"{name}: its path is from {start:g} to {end:g} s, not from 0 to {wish.duration:g} s")
    axis = rngs[_ERRORS].standard_normal(3)
    turn = np.deg2rad(recipe.rotation_error) * axis / np.linalg.norm(axis)
    errors = Miscalibration(recipe.disparity_offset, rotation=(float(turn[0]), float(turn[1]), float(turn[2])))
    rig = preset.rig(recipe.width or preset.width, recipe.height or preset.height, rngs[_RIG], errors)
    drift, difference = EXPOSURES[recipe.sensor]
    gains = exposure_gains(rngs[_GAINS], recipe.frames, drift, difference)
    sensor = SENSORS[recipe.sensor]
    draft = Simulation(
        episode.scene, episode.path, rig, preset.fps, recipe.frames, preset.layout, sensor, gains, recipe.seed
    )
    return replace(draft, sensor=replace(sensor, gain=_metered_gain(draft)))


def inertial_of(recipe: Recipe, simulation: Simulation) -> SimulatedInertial:
    """What the inertial sensor of a recipe measures, in the frame of the true poses that the layout has."""
    assert recipe.imu is not None
    rng = np.random.default_rng((recipe.seed, _INERTIAL))
    path, is_kitti = simulation.path, simulation.layout == "kitti"
    T_truth_world = np.linalg.inv(path.poses(0.0)) if is_kitti else np.eye(4)
    return simulate_inertial(path, float(simulation.times[-1]), recipe.imu, rng, T_truth_world)


class Studio:
    """Makes the frames of a simulation.

    Args:
        simulation: what is to be filmed.
        device: where it is drawn.
    """

    def __init__(self, simulation: Simulation, device: str = "cpu") -> None:
        self.simulation = simulation
        self.renderer = Renderer(simulation.scene, device)
        self.left, self.right = Eye(simulation.rig.left), Eye(simulation.rig.true_right)

    def views(self, numbers: np.ndarray) -> tuple[RenderedViews, RenderedViews]:
        """What the left and the right camera see in the frames of these numbers, before the sensor."""
        simulation, renderer = self.simulation, self.renderer
        times = numbers / simulation.fps
        T_left = simulation.path.poses(times)
        sunlight = renderer.sunlight(T_left, times)
        left = renderer.render(self.left, T_left, times, sunlight=sunlight)
        T_right = T_left @ simulation.rig.true_right_pose
        return left, renderer.render(self.right, T_right, times, T_left, sunlight)

    def frames(self, numbers: np.ndarray, views: tuple[RenderedViews, RenderedViews] | None = None) -> list[Frame]:
        """The frames of these numbers; on a GPU it pays to ask for many at once.

        Args:
            numbers: (V,) of the frames.
            views: theirs from `views`, made here unless given.
        """
        simulation, renderer = self.simulation, self.renderer
        left, right = views or self.views(numbers)
        later = numbers / simulation.fps + 1.0 / simulation.fps
        T_left_next = simulation.path.poses(later)
        T_left_right = simulation.rig.true_right_pose
        motion, seen_next = flow(left, renderer.look(self.left, T_left_next, later))
        stereo, seen_right = flow(left, right.sight)
        blurred = simulation.sensor.shutter > 0
        if blurred:
            right_motion, _ = flow(right, renderer.look(self.right, T_left_next @ T_left_right, later), occlusion=False)
        result = []
        for k, number in enumerate(numbers):
            depth = left.depth[k].cpu().numpy()
            motions = (motion[k].cpu().numpy(), right_motion[k].cpu().numpy() if blurred else None)
            eyes = []
            for eye, (seen, field) in enumerate(zip((left, right), motions, strict=True)):
                eyes.append(self._expose(seen, k, int(number), eye, field))
            result.append(
                Frame(
                    eyes[0],
                    eyes[1],
                    depth.astype(np.float32),
                    left.body[k].cpu().numpy().astype(np.int16),
                    motions[0],
                    seen_next[k].cpu().numpy(),
                    stereo[k].cpu().numpy(),
                    seen_right[k].cpu().numpy(),
                )
            )
        return result

    def _expose(self, views: RenderedViews, index: int, number: int, eye: int, field: np.ndarray | None) -> np.ndarray:
        simulation = self.simulation
        gain = simulation.sensor.gain * float(simulation.gains[number, eye])
        sensor = replace(simulation.sensor, gain=gain)
        rng = np.random.default_rng((simulation.seed, _NOISE, number, eye))
        depth = views.depth[index].cpu().numpy() if sensor.aperture > 0 else None
        return expose(views.image[index].cpu().numpy(), sensor, rng, field, depth)


def _metered_gain(simulation: Simulation) -> float:
    """The gain that brings the mean light of a few frames to middle grey; small images will do."""
    camera = simulation.rig.left
    shrink = 96 / camera.width
    small = replace(
        camera,
        width=96,
        height=max(16, round(camera.height * shrink)),
        fx=camera.fx * shrink,
        fy=camera.fy * shrink,
        cx=(camera.cx + 0.5) * shrink - 0.5,
        cy=(camera.cy + 0.5) * shrink - 0.5,
    )
    times = np.linspace(0.0, simulation.times[-1], _METERED)
    with torch.inference_mode():
        views = Renderer(simulation.scene).render(Eye(small), simulation.path.poses(times), times)
    means = views.image.clamp_max(4.0 * float(views.image.median()) + 1e-9).mean(dim=(1, 2))
    return _BRIGHTNESS / max(float(means.mean()), 1e-6)
