"""From corners of a board to a calibration: start, bundle adjustment, outliers, covariance."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sigmaslam.calibration.board_bundle import BoardBundle, Corners, Rig, project_corners, solve_bundle
from sigmaslam.calibration.boards import MIN_CORNERS, DetectedCorners
from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.camera import CameraModel, DistortionModel
from sigmaslam.geometry.se3 import rigid_motion, rotation_log, se3_inverse, transform_points

LENSES: dict[str, tuple[DistortionModel, int]] = {
    "none": ("none", 0),
    "radtan4": ("radtan", 4),
    "radtan5": ("radtan", 5),
    "radtan8": ("radtan", 8),
    "equidistant": ("equidistant", 4),
}
"""Lens models by their names on the command line, with the number of coefficients."""

MIN_IMAGES = 3
# An image with so many times the rms of the median image does not belong to this board; it is blurred or misread.
OUTLIER_IMAGE = 3.0
# A corner so many sigmas off, of which the normal distribution has one in 270,000.
OUTLIER_CORNER = 5.0
# A lens model that does not fit would lose its border round by round.
_CORNER_ROUNDS = 5
# Focal lengths to start from, in image widths: fields of view of 14 to 120 degrees (pinhole).
_FOCAL_STARTS = np.geomspace(0.3, 4.0, 12)
# Of what an image knows least, the share that other images know.
_LEAST_OUTSIDE = 0.05
# Sigma of a normal coordinate from the median distance in the plane: sqrt(2 ln 2).
_MEDIAN_DISTANCE = 1.17741


@dataclass(frozen=True, slots=True)
class OutlierImage:
    """An image pair that is not used, and why."""

    name: str
    reason: str


@dataclass(frozen=True, slots=True)
class BoardCalibration:
    """A calibration with how well it is known.

    Attributes:
        covariance: (P, P) of `rig.names`; pixels, coefficients, metres, radians.
        sigma: of a corner's coordinate, pixels.
        design_effect: by how much corners of one image that are wrong together enlarge the covariance.
        names: (n,) of the image pairs that are used.
        corners: those that are used.
        residuals: (N, 2) theirs, pixels.
        outlier_images: those that are not used.
        outlier_corners: single corners of these images that are not used.
        outlier_residuals: (K, 2) theirs, pixels.
    """

    rig: Rig
    covariance: np.ndarray
    sigma: float
    design_effect: float
    names: tuple[str, ...]
    corners: Corners
    residuals: np.ndarray
    outlier_images: tuple[OutlierImage, ...]
    outlier_corners: Corners
    outlier_residuals: np.ndarray
    bundle: BoardBundle

    @property
    def rms(self) -> float:
        """Root of the mean squared distance of corners from their projections, pixels; OpenCV's rms."""
        return _rms(self.residuals)

    @property
    def rms_of_all(self) -> float:
        """The same with the single corners that are not used."""
        return _rms(np.concatenate([self.residuals, self.outlier_residuals]))

    def eye_rms(self, eye: int) -> float:
        """The same of one eye."""
        return _rms(self.residuals[self.corners.eye == eye])

    @property
    def sigmas(self) -> np.ndarray:
        """(P,) standard deviations of `rig.names`."""
        return np.sqrt(np.diag(self.covariance))


def calibrate(
    names: Sequence[str],
    views: Sequence[Sequence[DetectedCorners]],
    points: np.ndarray,
    sizes: Sequence[tuple[int, int]],
    lens: str,
) -> BoardCalibration:
    """Calibrate one camera or a stereo pair.

    Args:
        names: of the images or pairs.
        views: of each, the corners in each eye (one or two); a board that one eye alone sees counts as well.
        points: (M, 3) of the board, metres.
        sizes: (width, height) of each eye's images.
        lens: one of `LENSES`.

    Raises:
        CalibrationError: too few images show the board.
    """
    corners, outliers = _gather(names, views, points)
    eyes = [_calibrate_eye(corners.select(corners.eye == k), size, lens) for k, size in enumerate(sizes)]
    rig = Rig(tuple(eyes), np.eye(4))
    if len(eyes) > 1:
        rig = replace(rig, T_left_right=_place_right_camera(rig, corners))
    bundle, corners, refused, dropped = _solve_without_outliers(rig, corners)
    outliers += [OutlierImage(names[image], reason) for image, reason in refused]
    numbers, images = np.unique(corners.image, return_inverse=True)
    covariance, sigma, effect = rig_covariance(bundle)
    single = replace(dropped, image=np.searchsorted(numbers, dropped.image))
    used = tuple(names[k] for k in numbers), replace(corners, image=images), bundle.residuals, tuple(outliers)
    alone = single, single.pixels - project_corners(bundle.rig, bundle.poses, single)
    return BoardCalibration(bundle.rig, covariance, sigma, effect, *used, *alone, bundle)


def rig_covariance(bundle: BoardBundle) -> tuple[np.ndarray, float, float]:
    """Covariance of the rig's parameters at the solution.

    Corners of one image are wrong together (the board bends, its light is uneven, the lens model lacks something), so
    the inverse of the information H is too small. By how much says the design effect: how far the gradients g of the
    images scatter beyond what independent corners would make them, S - S H^-1 S with the image's information S.
    The covariance is the jackknife's over images, H^-1 (sum of z z^T) H^-1 with z = (1 - S H^-1)^-1 g. As the sum is of
    few images, it is mixed with the information, which every direction is part of: the more, the less the images
    differ from independent corners.

    Returns:
        Covariance (P, P), sigma of a corner's coordinate in pixels, design effect (at least one).

    Raises:
        CalibrationError: there are as many unknowns as corners.
    """
    information = bundle.information.sum(axis=0)
    images, size = bundle.gradient.shape
    free = bundle.residuals.size - size - 6 * images
    if free <= 0:
        raise CalibrationError(f"{bundle.residuals.size // 2} corners are too few for {images} images: take more")
    variance = float(np.sum(bundle.residuals**2)) / free
    # In coordinates where the information of all images is the identity.
    scale = np.sqrt(np.diag(information))
    try:
        root = np.linalg.inv(np.linalg.cholesky(information / np.outer(scale, scale))) / scale
    except np.linalg.LinAlgError:
        raise CalibrationError("the images leave a camera parameter open: take more, with the board tilted") from None
    shares = root @ bundle.information @ root.T
    gradients = bundle.gradient @ root.T
    expected = variance * (size - float(np.sum(shares**2)))
    effect = max(1.0, float(np.sum(gradients**2)) / expected)
    # An image that alone determines a parameter shows no error in it.
    values, vectors = np.linalg.eigh(np.eye(size) - shares)
    outside = (vectors / np.maximum(values, _LEAST_OUTSIDE)[:, None]) @ np.swapaxes(vectors, -1, -2)
    errors = np.einsum("nij,nj->ni", outside, gradients)
    scatter = errors.T @ errors * (images - 1) / images
    mixed = (1.0 - 1.0 / effect) * scatter + variance / effect * np.eye(size)
    mixed *= max(1.0, float(np.trace(scatter) / np.trace(mixed)))
    covariance = root.T @ mixed @ root
    return 0.5 * (covariance + covariance.T), float(np.sqrt(variance)), effect


def _gather(
    names: Sequence[str], views: Sequence[Sequence[DetectedCorners]], points: np.ndarray
) -> tuple[Corners, list[OutlierImage]]:
    """All corners of images with enough of them, and the images without."""
    parts, outliers = [], []
    for image, (name, eyes) in enumerate(zip(names, views, strict=True)):
        if max(len(view) for view in eyes) < MIN_CORNERS:
            outliers.append(OutlierImage(name, "the board is not found"))
            continue
        for eye, view in enumerate(_same_direction(eyes)):
            if len(view) >= MIN_CORNERS:
                count = len(view)
                parts.append(Corners(np.full(count, image), np.full(count, eye), points[view.ids], view.pixels))
    if not parts:
        raise CalibrationError(
            f"the board is found in none of {len(names)} images: check --board (a chessboard has the numbers of its "
            "inner corners, one less than of squares) and the images"
        )
    return Corners.concatenate(parts), outliers


def _same_direction(eyes: Sequence[DetectedCorners]) -> Sequence[DetectedCorners]:
    """Both eyes with the numbering of the left one: that of a chessboard may begin at either end."""
    if len(eyes) < 2 or len(eyes[0]) != len(eyes[1]) or not np.array_equal(eyes[0].ids, eyes[1].ids):
        return eyes
    left, right = (view.pixels[-1] - view.pixels[0] for view in eyes)
    return eyes if left @ right > 0.0 else (eyes[0], replace(eyes[1], pixels=eyes[1].pixels[::-1]))


def _calibrate_eye(corners: Corners, size: tuple[int, int], lens: str) -> CameraModel:
    """One camera from its own images: the best of some focal lengths to start from, then the bundle."""
    model, count = LENSES[lens]
    width, height = size
    corners = replace(corners, eye=np.zeros_like(corners.eye))
    best, least = None, np.inf
    for focal in (_FOCAL_STARTS * max(size)).tolist():
        start = CameraModel(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, 0.0, model, (0.0,) * count)
        rig = Rig((start,), np.eye(4))
        rms = [image_rms for image_rms, _ in _board_poses(rig, corners).values()]
        if len(rms) >= MIN_IMAGES and np.median(rms) < least:
            best, least = rig, float(np.median(rms))
    if best is None:
        images = len(np.unique(corners.image))
        raise CalibrationError(f"{images} images show the board to one camera: take {MIN_IMAGES} or more, tilted")
    return _solve_without_outliers(best, corners)[0].rig.eyes[0]


def _board_poses(rig: Rig, corners: Corners) -> dict[int, tuple[float, np.ndarray]]:
    """By image, the rms in units of the focal length, times it, and the pose T_eye_board, from one camera's corners."""
    eye, poses = rig.eyes[0], {}
    rays = eye.unproject(corners.pixels)
    for image in np.unique(corners.image).tolist():
        mine = (corners.image == image) & np.isfinite(rays[:, 0])
        if np.count_nonzero(mine) < MIN_CORNERS:
            continue
        found = cv2.solvePnP(corners.points[mine], rays[mine, :2].copy(), np.eye(3), None)
        if found[0] and found[2][2, 0] > 0.0:
            T = rigid_motion(cv2.Rodrigues(found[1])[0], found[2][:, 0])
            seen = eye.project(transform_points(T, corners.points[mine]))
            poses[image] = (_rms(seen - corners.pixels[mine]), T)
    return poses


def _place_right_camera(rig: Rig, corners: Corners) -> np.ndarray:
    """(4, 4) T_left_right: of those that single pairs give, the one nearest to all others."""
    left, right = (
        _board_poses(Rig((eye,), np.eye(4)), corners.select(corners.eye == k)) for k, eye in enumerate(rig.eyes)
    )
    both = sorted(left.keys() & right.keys())
    if not both:
        raise CalibrationError("no pair shows the board to both eyes: take images where it is in view of both")
    candidates = np.array([left[image][1] @ se3_inverse(right[image][1]) for image in both])
    apart = se3_inverse(candidates)[:, None] @ candidates
    turned = np.linalg.norm(rotation_log(apart[..., :3, :3]), axis=-1)
    moved = np.linalg.norm(apart[..., :3, 3], axis=-1) / np.median(np.linalg.norm(candidates[:, :3, 3], axis=-1))
    return np.asarray(candidates[np.argmin(np.sum(turned + moved, axis=1))])


def _solve_without_outliers(rig: Rig, corners: Corners) -> tuple[BoardBundle, Corners, list[tuple[int, str]], Corners]:
    """The bundle of all images that agree, its corners, the numbers of the other images with reasons, other corners."""
    refused: list[tuple[int, str]] = []
    all_corners = corners
    dropped = np.zeros(len(corners), bool)
    rounds = 0
    while True:
        corners = all_corners.select(~dropped)
        poses = _start_poses(rig, corners)
        numbers = np.unique(corners.image)
        lost = [image for image in numbers.tolist() if image not in poses]
        if lost:
            refused += [(image, "no pose of the board fits its corners") for image in lost]
            dropped |= np.isin(all_corners.image, lost)
            continue
        if len(numbers) < MIN_IMAGES:
            raise CalibrationError(f"{len(numbers)} images agree on the cameras: take more, sharp and of a flat board")
        positions = np.searchsorted(numbers, corners.image)
        start = np.array([poses[image] for image in numbers.tolist()])
        bundle = solve_bundle(rig, start, replace(corners, image=positions))
        rig = bundle.rig
        squared = np.sum(bundle.residuals**2, axis=1)
        # A quarter, as single wrong corners are left out below, and one eye that is misread is about half of a pair.
        sizes = np.sqrt([np.quantile(squared[positions == k], 0.75) for k in range(len(numbers))])
        wrong = sizes > OUTLIER_IMAGE * np.median(sizes)
        if wrong.any():
            for image, size in zip(numbers[wrong].tolist(), sizes[wrong].tolist(), strict=True):
                times = size / np.median(sizes)
                refused.append((image, f"a quarter of its corners are {size:.2f} px off, {times:.1f} times the usual"))
            dropped |= np.isin(all_corners.image, numbers[wrong])
            continue
        limit = OUTLIER_CORNER * float(np.sqrt(np.median(squared))) / _MEDIAN_DISTANCE
        far = squared > max(limit, 1e-9) ** 2
        if not far.any() or rounds == _CORNER_ROUNDS:
            break
        rounds += 1
        dropped[np.flatnonzero(~dropped)[far]] = True
        thin = np.bincount(all_corners.image[~dropped], minlength=len(all_corners)) < MIN_CORNERS
        for image in [image for image in numbers.tolist() if thin[image]]:
            refused.append((image, f"fewer than {MIN_CORNERS} corners agree with the others"))
            dropped |= all_corners.image == image
    single = dropped & ~np.isin(all_corners.image, [image for image, _ in refused])
    return bundle, corners, refused, all_corners.select(single)


def _start_poses(rig: Rig, corners: Corners) -> dict[int, np.ndarray]:
    """T_left_board by image, from the left eye where it sees the board, else from the right one."""
    poses: dict[int, np.ndarray] = {}
    for k in reversed(range(len(rig.eyes))):
        seen = _board_poses(Rig((rig.eyes[k],), np.eye(4)), corners.select(corners.eye == k))
        to_left = rig.T_left_right if k else np.eye(4)
        poses |= {image: to_left @ T for image, (_, T) in seen.items()}
    return poses


def _rms(residuals: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=-1))))
