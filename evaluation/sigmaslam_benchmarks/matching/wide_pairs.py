"""Wide pairs whose places are known by depth: photographs by semi-global matching, renders exactly."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.geometry.se3 import se3_inverse
from sigmaslam.readers import open_sequence
from sigmaslam.reconstruction.disparity import measure_disparity, semi_global_disparity
from sigmaslam_benchmarks.matching import photographs, sequence_pairs
from sigmaslam_benchmarks.matching.image_pairs import Motion

# Depths of two neighbours, and of the two images of a pair, are of one surface within these shares.
_AGREES, _SEEN = 0.01, 0.02
# Places this near to the border of an image are not asked for, pixels.
_BORDER = 8
# Wide pairs of keyframes: metres aside and degrees turned; so many of them, evenly.
_ASIDE, _TURNED, _KEYFRAME_PAIRS = (0.7, 2.5), 35.0, 24
# Renders of worlds that no network that ships has learned from beside three that it has.
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


class _View:
    """A photograph with the depths that its neighbours give it.

    Args:
        image: (H, W) uint8.
        K: (3, 3).
        T_world_camera: (4, 4).
        neighbours: image, K and T_world_camera of each.
    """

    def __init__(
        self,
        image: np.ndarray,
        K: np.ndarray,
        T_world_camera: np.ndarray,
        neighbours: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
    ) -> None:
        self.image, self.K, self.T_world_camera = image, K, T_world_camera
        self._depths = [
            _depth_by_stereo(image, K, other, K_other, se3_inverse(T_world_camera) @ T_world_other)
            for other, K_other, T_world_other in neighbours
        ]

    def depth(self, pixels: np.ndarray) -> np.ndarray:
        """(N,) depths at pixels (N, 2), NaN where none is known or the neighbours differ."""
        depths = np.array([depth(pixels) for depth in self._depths])
        known = np.isfinite(depths)
        mean = np.where(known, depths, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        differ = (known & (np.abs(depths - mean) > _AGREES * mean)).any(axis=0)
        return np.where(known.any(axis=0) & ~differ, mean, np.nan)

    def transfer_to(self, other: "_View") -> Transfer:
        """To another photograph."""
        T = se3_inverse(other.T_world_camera) @ self.T_world_camera
        last = np.array(other.image.shape[::-1]) - 1

        def transfer(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            rays = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(self.K).T
            there = (rays * self.depth(points)[:, None]) @ T[:3, :3].T + T[:3, 3]
            known = np.flatnonzero(there[:, 2] > 0)  # not where the depth is NaN
            places, seen = np.full((len(points), 2), np.nan), np.zeros(len(points), bool)
            projected = there[known] @ other.K.T
            places[known] = projected[:, :2] / projected[:, 2:]
            inside = known[((places[known] >= _BORDER) & (places[known] <= last - _BORDER)).all(axis=1)]
            z = there[inside, 2]
            seen[inside] = np.abs(other.depth(places[inside]) - z) < _SEEN * z
            return places, seen

        return transfer


def _depth_by_stereo(
    image: np.ndarray, K: np.ndarray, other: np.ndarray, K_other: np.ndarray, T: np.ndarray
) -> Callable[[np.ndarray], np.ndarray]:
    """Depths of an image's pixels by matching it with its right or left neighbour at pose T (4, 4)."""
    height, width = image.shape
    mirrored = T[0, 3] < 0  # then the neighbour is the left eye: seen in a mirror it is the right one
    if mirrored:
        M = np.diag([-1.0, 1.0, 1.0, 1.0])
        T = M @ T @ M
        image, other = (np.ascontiguousarray(each[:, ::-1]) for each in (image, other))
    centres = [width - 1 - each[0, 2] if mirrored else each[0, 2] for each in (K, K_other)]
    eyes = [
        CameraModel(width, height, each[0, 0], each[1, 1], centre, each[1, 2])
        for each, centre in zip((K, K_other), centres, strict=True)
    ]
    rectifier = StereoRectifier(StereoCamera(eyes[0], eyes[1], T))
    view = rectifier.rectified
    found = measure_disparity(*rectifier.rectify(image, other), semi_global_disparity).disparity

    def depth(pixels: np.ndarray) -> np.ndarray:
        u = width - 1 - pixels[:, 0] if mirrored else pixels[:, 0]
        rays = eyes[0].unproject(np.column_stack([u, pixels[:, 1]]))
        turned = rays @ rectifier.R_rectified_left.T
        column = view.fx * turned[:, 0] / turned[:, 2] + view.cx
        row = view.fy * turned[:, 1] / turned[:, 2] + view.cy
        inside = (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
        disparity = np.full(len(pixels), np.nan)
        index = np.round(row[inside]).astype(int), np.round(column[inside]).astype(int)
        disparity[inside] = found[index]
        disparity[~(disparity > 0)] = np.nan
        return np.asarray(rays[:, 2] * view.fx * view.baseline / disparity / turned[:, 2])

    return depth


def fountain(data: Path) -> list[WidePair]:
    """All six pairs of four photographs, in parts by how many photographs apart they are."""
    views = list(photographs.fountain_views(data / "strecha_fountain_P11").values())
    seen = [_View(*view, [views[j] for j in (k - 1, k + 1) if 0 <= j < len(views)]) for k, view in enumerate(views)]
    return [_related(f"{j - i} apart", seen[i], seen[j]) for i, j in combinations(range(len(seen)), 2)]


def euroc(data: Path) -> list[WidePair]:
    """24 pairs of keyframes that are 0.7 to 2.5 m and less than 35 degrees apart, with depths of the right eye."""
    folder = data / "euroc_v1_01_keyframes_a"
    views = list(sequence_pairs.views_of(open_sequence(folder), folder / "groundtruth.csv"))
    pairs = []
    for i, j in combinations(range(len(views)), 2):
        T = se3_inverse(views[i].T_world_camera) @ views[j].T_world_camera
        turn = np.degrees(Rotation.from_matrix(T[:3, :3]).magnitude())
        if _ASIDE[0] < np.linalg.norm(T[:3, 3]) < _ASIDE[1] and turn < _TURNED:
            pairs.append((i, j))
    pairs = [pairs[k] for k in np.linspace(0, len(pairs) - 1, _KEYFRAME_PAIRS).astype(int)]
    seen = {}
    for k in sorted({k for pair in pairs for k in pair}):
        view, eye = views[k], np.eye(4)
        eye[0, 3] = view.camera.baseline
        right = view.right, view.camera.matrix, view.T_world_camera @ eye
        seen[k] = _View(view.left, view.camera.matrix, view.T_world_camera, [right])
    return [_related("keyframes", seen[i], seen[j]) for i, j in pairs]


def renders(data: Path) -> list[WidePair]:
    """24 pairs of rendered worlds from directions up to 60 degrees apart; what moves, moves."""
    from sigmaslam_synthetic.scene_pairs import ScenePairs

    stream = ScenePairs(_SEED, _SIZE, _WORLDS, wide=True)
    pairs = []
    for index in range(_RENDERS):
        pair = stream.pair(index)
        images = [np.round(255.0 * image).astype(np.uint8) for image in (pair.image0, pair.image1)]
        pairs.append(WidePair("renders", images[0], images[1], pair.transfer, None))
    return pairs


def _related(part: str, view0: _View, view1: _View) -> WidePair:
    motion = Motion(view0.K, se3_inverse(view1.T_world_camera) @ view0.T_world_camera)
    return WidePair(part, view0.image, view1.image, view0.transfer_to(view1), motion)
