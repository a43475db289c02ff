"""One description of a scene: bodies, materials, lights. Plain numbers, so that scene.json holds all of it.

World axes: z up. Light is linear; a white surface under the sun at right angles has radiance 1 before exposure.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import rigid_motion
from sigmaslam_synthetic.motion.paths import Path
from sigmaslam_synthetic.rendering.shapes import SHAPES, Shape


@dataclass(frozen=True, slots=True)
class Texture:
    """A layer of texture.

    Attributes:
        kind: as `textures.paint` takes it.
        seed: of the texture.
        tile: side of the square that the texture covers, metres; it is repeated by mirroring.
        contrast: factor on its deviation from grey.
    """

    kind: str
    seed: int
    tile: float
    contrast: float = 1.0


@dataclass(frozen=True, slots=True)
class Material:
    """How a surface looks: albedo = brightness + the layers' deviations from grey.

    Attributes:
        brightness: mean albedo in [0, 1].
        layers: one or two textures; the second one breaks the repetition of the first.
        specular: strength of highlights.
        gloss: exponent of the highlights; larger is sharper.
        bump: slope by which the first texture tilts the normal in highlights.
    """

    brightness: float
    layers: tuple[Texture, ...]
    specular: float = 0.0
    gloss: float = 40.0
    bump: float = 0.0


@dataclass(frozen=True, slots=True)
class Body:
    """A rigid body.

    Attributes:
        shape: its form in its own frame.
        material: index into `Scene.materials`.
        position: where it stands, metres, world frame.
        rotation: rotation vector of T_world_body, radians.
        path: its motion in place of position and rotation; its times are those of the frames, seconds.
        shadow: whether it casts a shadow.
    """

    shape: Shape
    material: int
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    path: Path | None = None
    shadow: bool = True

    def pose(self, time: float) -> np.ndarray:
        """T_world_body at that time, (4, 4)."""
        if self.path is not None:
            return self.path.poses(np.array([time]))[0]
        return rigid_motion(Rotation.from_rotvec(self.rotation).as_matrix(), self.position)


@dataclass(frozen=True, slots=True)
class Lights:
    """What lights the scene; all parts add up.

    Attributes:
        ambient: from everywhere.
        sun: strength of the parallel light.
        sun_direction: where the parallel light comes from, world frame.
        shadows: whether the parallel light casts shadows.
        lamp: strength of a light that the camera carries, at 1 metre; it falls off with 1/r^2.
        lamp_offset: its place in the left camera's frame, metres.
        extinction: share of its light that what is seen loses in a metre of haze, which the sky's replaces (Koschmieder
            1924): 3.9 by the metres at which 2 % of a contrast are left; 0 in clear air.
    """

    ambient: float = 0.3
    sun: float = 0.0
    sun_direction: tuple[float, float, float] = (0.3, 0.4, 0.85)
    shadows: bool = True
    lamp: float = 0.0
    lamp_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    extinction: float = 0.0


@dataclass(frozen=True, slots=True)
class Scene:
    """All that is to be seen.

    Attributes:
        bodies: at least one; the index is the instance id.
        materials: what they are made of.
        lights: what lights them.
        sky: radiance where a ray meets nothing.
        near: nearest distance drawn, metres.
    """

    bodies: tuple[Body, ...]
    materials: tuple[Material, ...]
    lights: Lights
    sky: float = 0.9
    near: float = 0.05

    @property
    def moving(self) -> np.ndarray:
        """(bodies,) bool, which of them move on their own."""
        return np.array([body.path is not None for body in self.bodies])

    def to_json(self) -> dict[str, Any]:
        """The scene as JSON can hold it."""
        return {
            "bodies": [
                {
                    **{f.name: getattr(body, f.name) for f in fields(Body) if f.name not in ("shape", "path")},
                    "shape": {"kind": type(body.shape).__name__, **asdict(body.shape)},
                    "path": None if body.path is None else body.path.to_json(),
                }
                for body in self.bodies
            ],
            "materials": [asdict(material) for material in self.materials],
            "lights": asdict(self.lights),
            "sky": self.sky,
            "near": self.near,
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "Scene":
        """The scene that `to_json` wrote.

        Raises:
            InputError: a key is missing, or a value is not what it should be.
        """
        try:
            return cls(
                tuple(_body_from_json(body) for body in content["bodies"]),
                tuple(
                    Material(**{**m, "layers": tuple(Texture(**layer) for layer in m["layers"])})
                    for m in content["materials"]
                ),
                Lights(**_tuples(content["lights"])),
                content["sky"],
                content["near"],
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"the scene cannot be read: {type(error).__name__} {error}") from error


def _body_from_json(content: Mapping[str, Any]) -> Body:
    shape = dict(_tuples(content["shape"]))
    kinds = {kind.__name__: kind for kind in SHAPES}
    kind = shape.pop("kind")
    if kind not in kinds:
        raise InputError(f"shape {kind!r} is unknown; known are {', '.join(kinds)}")
    path = None if content["path"] is None else Path.from_json(content["path"])
    others = _tuples({key: value for key, value in content.items() if key not in ("shape", "path")})
    return Body(shape=kinds[kind](**shape), path=path, **others)


def _tuples(content: Mapping[str, Any]) -> dict[str, Any]:
    def convert(value: Any) -> Any:
        return tuple(convert(item) for item in value) if isinstance(value, list) else value

    return {key: convert(value) for key, value in content.items()}
