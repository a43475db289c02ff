"""A small scene with every kind of body, moving ones among them, for tests of geometry."""

import numpy as np

from sigmaslam.geometry.camera import CameraModel
from sigmaslam_synthetic.motion.paths import Path
from sigmaslam_synthetic.rendering.shapes import Box, Cylinder, Ellipsoid, Panel, Sheet
from sigmaslam_synthetic.scene import Body, Lights, Material, Scene, Texture

CAMERA = CameraModel(160, 120, 130.0, 130.0, 79.5, 59.5)
RADTAN = CameraModel(160, 120, 110.0, 112.0, 80.3, 58.9, 0.0, "radtan", (-0.28, 0.07, 0.0002, 0.00002))
FISHEYE = CameraModel(160, 120, 95.0, 95.0, 79.5, 59.5, 0.0, "equidistant", (-0.01, 0.004, -0.002, 0.0))


def small_scene(*, sun: float = 0.8, lamp: float = 0.0, moving: bool = True) -> Scene:
    """A floor, bumps, boxes, a pole, a ball and, if wanted, a box that flies by. All within x 2 to 8, y -3 to 3."""
    materials = (
        Material(0.5, (Texture("leaves", 1, 2.0), Texture("noise", 2, 5.0, 0.5))),
        Material(0.55, (Texture("bricks", 1, 1.5),), specular=0.4, gloss=30.0, bump=1.0),
    )
    bodies = [
        Body(Panel(16.0, 12.0), 0, (6.0, 0.0, 0.0)),
        Body(Sheet((4.0, 4.0), 0.08, 0.8, 5, cells=24), 1, (6.0, 2.0, 0.4)),
        Body(Box((0.8, 0.5, 1.1)), 1, (4.0, -0.7, 0.55), (0.0, 0.0, 0.4)),
        Body(Box((1.2, 0.6, 0.7)), 0, (5.5, 0.8, 0.35), (0.0, 0.0, -0.9)),
        Body(Cylinder(0.12, 2.2), 0, (4.6, 0.4, 1.1)),
        Body(Ellipsoid((0.4, 0.5, 0.3), 10), 1, (5.0, -1.6, 1.0)),
    ]
    if moving:
        path = Path(
            np.array([0.0, 1.0, 2.0]),
            np.array([[4.2, -1.5, 1.2], [4.0, 0.0, 1.5], [4.4, 1.4, 1.1]]),
            np.array([[0.0, 0.1, 0.2], [0.2, 0.1, 0.9], [0.3, -0.2, 1.6]]),
        )
        bodies.append(Body(Box((0.5, 0.4, 0.3)), 1, path=path))
    return Scene(tuple(bodies), materials, Lights(0.35, sun, (-0.5, 0.4, 0.8), lamp=lamp))


def camera_pose(position: tuple[float, float, float], yaw: float = 0.0, pitch: float = -0.15) -> np.ndarray:
    """T_world_camera of a camera that looks along x, turned by yaw to the left and by pitch upwards, (4, 4)."""
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = position
    return T
