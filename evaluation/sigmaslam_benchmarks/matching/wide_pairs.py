"""Wide pairs whose places are known by depth: photographs by semi-global matching, renders exactly."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.geometry.se3 import se3_inverse, transform_points
from sigmaslam.readers import open_sequence
from sigmaslam.reconstruction.disparity import measure_disparity, pixel_grid, semi_global_disparity
from sigmaslam_benchmarks.matching import photographs, sequence_pairs
from sigmaslam_benchmarks.matching.image_pairs import Motion

# A place is seen where the depth of the other image is its own to this share.
_SEEN = 0.02
# Places this near to the border of an image are not asked for, pixels.
_BORDER = 8
# Wide pairs of keyframes: metres aside and degrees turned; so many of them, evenly.
_ASIDE, _TURNED, _KEYFRAME_PAIRS = (0.7, 2.5), 35.0, 24
# Renders of three worlds that the network has learned from, and of rubble, which it has not.
_SEED, _SIZE, _RENDERS = 5_000_410, 384, 24
_WORLDS = ("street", "room", "drone", "rubble")

Transfer = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, slots=True)
class WidePair:
    """Two images of a scene with relief.

    Attributes:
        part: of its set.
        image0, image1: (H, W) uint8; the same array where several pairs share an image.
        transfer: from points (N, 2) of image 0 to places (N, 2) in image 1, and whether they are known and seen there.
        motion: between the images, None where parts of the scene move.
    """

    part: str
    image0: np.ndarray
    image1: np.ndarray
    transfer: Transfer
    motion: Motion | None


class View(NamedTuple):
    """A photograph (H, W) uint8, its K (3, 3) and T_world_camera (4, 4)."""

    image: np.ndarray
    K: np.ndarray
    T_world_camera: np.ndarray


def fountain(data: Path) -> list[WidePair]:
    """All six pairs of four photographs, in parts by how many photographs apart they are."""
    # They were taken from right to left.
    views = [View(*view) for view in photographs.fountain_views(data / "strecha_fountain_P11").values()]
    clouds = [stereo_cloud(left, right) for right, left in pairwise(views)]
    depths = [depth_map(clouds[max(k - 1, 0) : k + 1], view) for k, view in enumerate(views)]
    chosen = combinations(range(len(views)), 2)
    return [_related(f"{j - i} apart", views[i], views[j], depths[i], depths[j]) for i, j in chosen]


def euroc(data: Path) -> list[WidePair]:
    """24 pairs of keyframes that are 0.7 to 2.5 m and less than 35 degrees apart, with depths of the right eye."""
    folder = data / "euroc_v1_01_keyframes_a"
    frames = list(sequence_pairs.views_of(open_sequence(folder), folder / "groundtruth.csv"))
    chosen = []
    for i, j in combinations(range(len(frames)), 2):
        T = se3_inverse(frames[i].T_world_camera) @ frames[j].T_world_camera
        turn = np.degrees(Rotation.from_matrix(T[:3, :3]).magnitude())
        if _ASIDE[0] < np.linalg.norm(T[:3, 3]) < _ASIDE[1] and turn < _TURNED:
            chosen.append((i, j))
    chosen = [chosen[k] for k in np.linspace(0, len(chosen) - 1, _KEYFRAME_PAIRS).astype(int)]
    views, depths = {}, {}
    for k in {k for pair in chosen for k in pair}:
        K, eye = frames[k].camera.matrix, np.eye(4)
        eye[0, 3] = frames[k].camera.baseline
        views[k] = View(frames[k].left, K, frames[k].T_world_camera)
        cloud = stereo_cloud(views[k], View(frames[k].right, K, frames[k].T_world_camera @ eye))
        depths[k] = depth_map([cloud], views[k])
    return [_related("keyframes", views[i], views[j], depths[i], depths[j]) for i, j in chosen]


def renders(data: Path) -> list[WidePair]:
    """24 pairs of rendered worlds from directions up to 60 degrees apart; what moves, moves."""
    from sigmaslam_synthetic.scene_pairs import ScenePairs

    stream = ScenePairs(_SEED, _SIZE, _WORLDS, wide=True)
    pairs = []
    for pair in map(stream.pair, range(_RENDERS)):
        image0, image1 = (np.round(255.0 * image).astype(np.uint8) for image in (pair.image0, pair.image1))
        pairs.append(WidePair("renders", image0, image1, pair.transfer, None))
    return pairs


def stereo_cloud(left: View, right: View) -> np.ndarray:
    """Points (N, 3) in the world of two neighbouring photographs, by their disparities."""
    eyes = [
        CameraModel(each.image.shape[1], each.image.shape[0], each.K[0, 0], each.K[1, 1], each.K[0, 2], each.K[1, 2])
        for each in (left, right)
    ]
    T_left_right = se3_inverse(left.T_world_camera) @ right.T_world_camera
    rectifier = StereoRectifier(StereoCamera(eyes[0], eyes[1], T_left_right))
    images = rectifier.rectify(left.image, right.image)
    disparity = measure_disparity(*images, semi_global_disparity).disparity
    u, v = pixel_grid(*disparity.shape)
    found = disparity > 0.0  # not where it is NaN
    points = rectifier.rectified.triangulate(np.stack([u, v, disparity], axis=-1)[found].astype(np.float64))
    return np.asarray(transform_points(left.T_world_camera, points @ rectifier.R_rectified_left))


def depth_map(clouds: Iterable[np.ndarray], view: View) -> np.ndarray:
    """(H, W) depth of the nearest point of the clouds in each pixel; infinite where there is none."""
    depth = np.full(view.image.shape, np.inf)
    for points in clouds:
        there = transform_points(se3_inverse(view.T_world_camera), points)
        pixels, inside = _project(view, there, 0)
        u, v = np.round(pixels[inside]).astype(int).T
        np.minimum.at(depth, (v, u), there[inside, 2])
    return depth


def _project(view: View, points: np.ndarray, border: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) of points (N, 3) in the camera, and which lie in the image, so far from its border."""
    pixels = points @ view.K.T
    pixels = pixels[:, :2] / np.where(points[:, 2:] > 0, pixels[:, 2:], np.nan)
    last = np.array(view.image.shape[::-1]) - 1
    return pixels, ((pixels >= border) & (pixels <= last - border)).all(axis=1)


def _related(part: str, view0: View, view1: View, depth0: np.ndarray, depth1: np.ndarray) -> WidePair:
    motion = Motion(view0.K, se3_inverse(view1.T_world_camera) @ view0.T_world_camera)

    def transfer(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u, v = np.round(points).astype(int).clip(0, np.array(depth0.shape[::-1]) - 1).T
        rays = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(view0.K).T
        known = np.isfinite(depth0[v, u])
        there = transform_points(motion.T_1_0, rays * np.where(known, depth0[v, u], 1.0)[:, None])
        places, inside = _project(view1, there, _BORDER)
        column, row = np.round(np.where(inside[:, None], places, 0.0)).astype(int).T
        z = there[:, 2]
        return places, known & inside & (np.abs(depth1[row, column] - z) < _SEEN * z)

    return WidePair(part, view0.image, view1.image, transfer, motion)
