"""The geometry of two image files: `sigmaslam images geometry`."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.calibration_files.calibration import read_calibration
from sigmaslam.errors import InputError
from sigmaslam.files import atomic_write_bytes
from sigmaslam.frontend.image_pair import draw_lines, match_images
from sigmaslam.geometry.camera import CameraModel
from sigmaslam.geometry.image_cells import CELLS, image_cells
from sigmaslam.geometry.se3 import rotation_log
from sigmaslam.readers.images import read_grey
from sigmaslam.two_view.epipolar import essential_matrix
from sigmaslam.two_view.fundamental import (
    FundamentalMatrix,
    describe_epipole,
    epipolar_lines,
    estimate_fundamental,
    uncertain_epipoles,
)
from sigmaslam.two_view.relative_orientation import RelativeOrientation, estimate_relative_orientation

EYES = ("left", "right")
# A homography is that of a plane, or of a turn, if this share of the inliers follow it within so many pixels.
_PLANE_SHARE, _PLANE_THRESHOLD = 0.8, 2.0
# What so few inliers off the plane say of seven degrees of freedom is chance.
_LEAST_OFF_PLANE = 8
# Below so many inliers seven degrees of freedom fit by chance; in so few parts of the image they are one thing.
_LEAST_INLIERS, _FEWEST_CELLS, _FEW_CELLS = 16, 2, 6
# Another geometry is told if it has this share of the inliers of the first.
_SECOND_SHARE = 0.5
# From this probability on another pose is told; above these standard deviations, degrees, a direction is not.
_TOLD_RIVAL, _VAGUE, _UNKNOWN = 0.05, 10.0, 45.0
# More lines and points hide the image; between so many samples a line bent by a lens looks round.
_DRAWN_LINES, _DRAWN_MATCHES, _LINE_SAMPLES = 12, 100, 200


@dataclass(frozen=True, slots=True)
class ImageGeometry:
    """What the matches of two images say.

    Attributes:
        points0, points1: (M, 2) keypoints of the matches as they are in the images, pixels.
        fundamental: of the pixels as a camera without distortion would see them.
        pose: None without calibration, or where there is none.
        plane_share: share of the inliers that one homography explains within two pixels.
        cells: parts of image 0, of 24, with inliers.
        second: number of the other matches that agree on another geometry.
        size: width and height of image 0, pixels.
        known: (4, 4) T_1_0 of the calibration, if both eyes of it took the images; else None.
    """

    points0: np.ndarray
    points1: np.ndarray
    fundamental: FundamentalMatrix
    pose: RelativeOrientation | None
    plane_share: float
    cells: int
    second: int
    size: tuple[int, int]
    known: np.ndarray | None

    @property
    def inliers(self) -> np.ndarray:
        """(M,) bool, of the pose where there is one."""
        return self.fundamental.inliers if self.pose is None else self.pose.inliers

    def describe(self) -> str:
        """Lines for people."""
        lines = [f"{len(self.points0)} matches, {self.inliers.sum()} agree on one geometry"]
        if self.pose is not None:
            lines += _describe_pose(self.pose)
        elif self.plane_share * self.inliers.sum() > self.inliers.sum() - _LEAST_OFF_PLANE:
            lines.append("They follow one homography: a plane or a mere turn, from which the epipoles are not known.")
        else:
            for number, epipole in enumerate(uncertain_epipoles(self.fundamental)):
                lines.append(f"Camera {1 - number} is seen by image {number} {describe_epipole(*epipole, self.size)}.")
        if self.known is not None and self.pose is not None:
            turn, direction = self.known[:3, :3] @ self.pose.R.T, self.known[:3, 3] / np.linalg.norm(self.known[:3, 3])
            lines.append(
                f"The calibration differs by {np.degrees(np.linalg.norm(rotation_log(turn))):.2f} deg of rotation and "
                f"{np.degrees(np.arccos(np.clip(direction @ self.pose.direction, -1.0, 1.0))):.2f} deg of direction."
            )
        if self.plane_share >= _PLANE_SHARE:
            lines.append(
                f"{100 * self.plane_share:.0f} % of them follow one homography: a plane, a mere turn, or a baseline "
                "far shorter than the depth. The geometry is less known than from a scene with depth."
            )
        if self.cells <= _FEW_CELLS:
            lines.append(
                f"They lie in {self.cells} of {CELLS} parts of image 0: whatever is there may move on its own, and "
                "errors of a lens weigh more. Do not rely on the sigmas."
            )
        if self.second >= _SECOND_SHARE * self.inliers.sum():
            lines.append(
                f"Another {self.second} matches agree on another geometry: something moves, or the scene repeats "
                "itself, and either may be the right one."
            )
        return "\n".join(lines)


def describe_files(
    path0: Path,
    path1: Path,
    calibration: Path | None = None,
    eyes: tuple[str, str] = ("left", "left"),
    picture: Path | None = None,
    frontend: str = "learned",
    max_keypoints: int = 1024,
) -> str:
    """Matches two image files, estimates their geometry, draws it, and describes it.

    Args:
        calibration: of the stereo pair that took them, in any form; None: the geometry of uncalibrated views.
        eyes: which of its cameras took which, "left" or "right".
        picture: PNG to draw.
        frontend, max_keypoints: of `match_images`.
    Raises:
        InputError: a file cannot be read or does not fit, or the images have no geometry in common.
    """
    if picture is not None and picture.suffix != ".png":
        raise InputError(f"--picture {picture} does not end in .png: choose a name that does")
    image0, image1 = read_grey(path0), read_grey(path1)
    models, known = _cameras(calibration, eyes, image0.shape)
    for path, image, model in zip((path0, path1), (image0, image1), models or (), strict=False):
        if image.shape != (model.height, model.width):
            raise InputError(
                f"{path} is {image.shape[1]}x{image.shape[0]} pixels, the calibration is of {model.width}x"
                f"{model.height}: give the calibration of these images"
            )
    found = estimate_geometry(image0, image1, models, known, frontend, max_keypoints)
    if found is None:
        raise InputError(
            f"{path0} and {path1}: fewer than {_LEAST_INLIERS} matches agree on a geometry, or they lie in "
            f"{_FEWEST_CELLS} or fewer of {CELLS} parts of the image; do both show the same scene?"
        )
    if picture is not None:
        drawn = draw_geometry(image0, image1, found, models)
        atomic_write_bytes(picture, cv2.imencode(".png", drawn)[1].tobytes())
    return found.describe()


def estimate_geometry(
    image0: np.ndarray,
    image1: np.ndarray,
    models: tuple[CameraModel, CameraModel] | None = None,
    known: np.ndarray | None = None,
    frontend: str = "learned",
    max_keypoints: int = 1024,
) -> ImageGeometry | None:
    """Geometry of two images (H, W) uint8.

    Args:
        models: the cameras that took them; None: unknown.
        known: (4, 4) T_1_0, if the calibration says it.
        frontend, max_keypoints: of `match_images`.
    Returns:
        None where fewer than 16 matches agree, or they lie in no more than two of 24 parts of image 0.
    """
    matches = match_images(image0, image1, frontend, max_keypoints)
    ideal0, ideal1 = _ideal(matches.keypoints0, models, 0), _ideal(matches.keypoints1, models, 1)
    covariance = matches.covariance.astype(np.float64)
    fundamental = estimate_fundamental(ideal0, ideal1, matches.probability, covariance)
    if fundamental is None:
        return None
    pose = None
    if models is not None:
        # Both as camera 0 would see them.
        K0, K1 = (model.matrix for model in models)
        change = K0 @ np.linalg.inv(K1)
        as_first = np.column_stack([ideal1, np.ones(len(ideal1))]) @ change.T
        spread = change[:2, :2] @ covariance @ change[:2, :2].T
        pose = estimate_relative_orientation(K0, ideal0, as_first[:, :2], matches.probability, spread)
    inliers = fundamental.inliers if pose is None else pose.inliers
    height, width = image0.shape
    cells = len(np.unique(image_cells(matches.keypoints0[inliers], width, height)))
    if inliers.sum() < _LEAST_INLIERS or cells <= _FEWEST_CELLS:
        return None
    rest = ~inliers
    other = estimate_fundamental(ideal0[rest], ideal1[rest], matches.probability[rest], covariance[rest])
    second = 0 if other is None else int(other.inliers.sum())
    share = _plane_share(ideal0[inliers], ideal1[inliers])
    return ImageGeometry(
        matches.keypoints0, matches.keypoints1, fundamental, pose, share, cells, second, (width, height), known
    )


def draw_geometry(
    image0: np.ndarray, image1: np.ndarray, geometry: ImageGeometry, models: tuple[CameraModel, CameraModel] | None
) -> np.ndarray:
    """Matches above, and below a dozen points with their epipolar lines in the other image; (2 H, W, 3) BGR.

    Lines are curves where the lens is not straight.
    """
    agree = np.flatnonzero(geometry.inliers)
    chosen = agree[np.linspace(0, len(agree) - 1, min(len(agree), _DRAWN_MATCHES)).round().astype(int)]
    above = draw_lines(
        image0, image1, geometry.points0[chosen], geometry.points1[chosen], [(80, 200, 120)] * len(chosen)
    )
    # Points of all heights and sides.
    order = agree[np.argsort(geometry.points0[agree] @ (1.0, 1.7))]
    some = order[np.linspace(0, len(order) - 1, min(len(order), _DRAWN_LINES)).round().astype(int)]
    palette = cv2.applyColorMap(np.linspace(0, 255, _DRAWN_LINES).astype(np.uint8), cv2.COLORMAP_TURBO).reshape(-1, 3)
    colours = palette[: len(some)].tolist()
    below = draw_lines(image0, image1, np.zeros((0, 2)), np.zeros((0, 2)), [])
    F, offset = _pixel_matrix(geometry, models), np.array([image0.shape[1], 0])
    sides = (
        (geometry.points1, geometry.points0, F.T, 0, np.zeros(2), image0),
        (geometry.points0, geometry.points1, F, 1, offset, image1),
    )
    for others, own, matrix, number, shift, image in sides:
        lines = epipolar_lines(matrix, _ideal(others[some], models, 1 - number))
        for line, point, colour in zip(lines, own[some], colours, strict=True):
            for curve in _curves(line, image.shape, None if models is None else models[number]):
                cv2.polylines(below, [(curve + shift).round().astype(np.int32)], False, colour, 1, cv2.LINE_AA)
            cv2.circle(below, (point + shift).round().astype(int).tolist(), 4, colour, 2, cv2.LINE_AA)
    return np.concatenate([above, below])


def _describe_pose(pose: RelativeOrientation) -> list[str]:
    turn, sigma = rotation_log(pose.R), np.degrees(np.sqrt(np.diag(pose.covariance)))
    angle = np.linalg.norm(turn)
    axis = turn / angle if angle > 0.0 else np.zeros(3)
    x, y, z = -pose.R.T @ pose.direction
    # Of the direction, the larger of the two.
    spread = np.degrees(np.sqrt(np.linalg.eigvalsh(pose.covariance[:3, :3])[-1]))
    place = (
        f"Camera 1 stands in the direction ({x:+.3f}, {y:+.3f}, {z:+.3f}) of camera 0 (x right, y down, z ahead); "
        f"sigma {spread:.2f} deg, its distance unknown"
    )
    if spread > _UNKNOWN:
        place = "The direction of camera 1 is not known: a mere turn, or poses that explain the matches alike"
    lines = [
        f"Rotation: {np.degrees(angle):.2f} deg about ({axis[0]:+.2f}, {axis[1]:+.2f}, {axis[2]:+.2f}); sigma "
        f"{sigma[3]:.2f}, {sigma[4]:.2f}, {sigma[5]:.2f} deg about x, y, z",
        place,
    ]
    if pose.rival >= _TOLD_RIVAL:
        by_turn, by_direction = np.degrees(pose.rival_angles)
        lines.append(
            f"Another pose is right with a probability of {100 * pose.rival:.0f} %: {by_turn:.1f} deg of rotation and "
            f"{by_direction:.0f} deg of direction from this one. The sigmas allow for it."
        )
    elif _VAGUE < spread <= _UNKNOWN:
        lines.append("The baseline is short for the depth, or the matches are few: the direction is vague.")
    return lines


def _cameras(
    calibration: Path | None, eyes: tuple[str, str], shape: tuple[int, ...]
) -> tuple[tuple[CameraModel, CameraModel] | None, np.ndarray | None]:
    """The cameras, and T_1_0 where they are the two of the pair."""
    for eye in eyes:
        if eye not in EYES:
            raise InputError(f"--eyes names {eye!r}: give two of left and right, as left,right")
    if calibration is None:
        return None, None
    pair = read_calibration(calibration, (shape[1], shape[0]))
    known = None
    if eyes == ("left", "right"):
        known = np.linalg.inv(pair.T_left_right)
    elif eyes == ("right", "left"):
        known = pair.T_left_right
    return (getattr(pair, eyes[0]), getattr(pair, eyes[1])), known


def _ideal(points: np.ndarray, models: tuple[CameraModel, CameraModel] | None, number: int) -> np.ndarray:
    """(M, 2) pixels without distortion, float64."""
    if models is None:
        return points.astype(np.float64)
    return np.asarray((models[number].unproject(points.astype(np.float64)) @ models[number].matrix.T)[:, :2])


def _plane_share(points0: np.ndarray, points1: np.ndarray) -> float:
    if len(points0) < 4:
        return 0.0
    H, mask = cv2.findHomography(points0, points1, cv2.USAC_ACCURATE, _PLANE_THRESHOLD)
    return 0.0 if np.shape(H) != (3, 3) else float(mask.mean())


def _pixel_matrix(geometry: ImageGeometry, models: tuple[CameraModel, CameraModel] | None) -> np.ndarray:
    """F of what is known best."""
    if geometry.pose is None or models is None:
        return geometry.fundamental.F
    E = essential_matrix(geometry.pose.R, geometry.pose.direction)
    return np.asarray(np.linalg.inv(models[1].matrix).T @ E @ np.linalg.inv(models[0].matrix))


def _curves(line: np.ndarray, shape: tuple[int, ...], model: CameraModel | None) -> list[np.ndarray]:
    """A line of ideal pixels as it runs through the image, in pieces (K, 2)."""
    height, width = shape
    nearest, along = -line[2] * line[:2], np.array([-line[1], line[0]])
    middle = along @ (np.array([0.5 * width, 0.5 * height]) - nearest)
    reach = np.linspace(-1.0, 1.0, _LINE_SAMPLES) * (width + height)
    places = nearest + (middle + reach)[:, None] * along
    if model is not None:
        rays = np.column_stack([places, np.ones(len(places))]) @ np.linalg.inv(model.matrix).T
        places = model.project(rays)
    inside = ((places >= -0.5) & (places <= (width - 0.5, height - 0.5))).all(axis=1)
    runs = np.split(np.arange(len(places)), np.flatnonzero(np.diff(inside.astype(int))) + 1)
    # One sample beyond either end, so that curves reach the border.
    pieces = [np.arange(max(run[0] - 1, 0), min(run[-1] + 2, len(places))) for run in runs if inside[run[0]]]
    clipped = [np.clip(places[piece], 0.0, (width - 1.0, height - 1.0)) for piece in pieces]
    return [piece for piece in clipped if np.isfinite(piece).all()]
