"""A run folder becomes a dense cloud, and a mesh: disparities of each keyframe, fused with its neighbours', merged."""

import time
from collections.abc import Generator, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_write_json, check_new_folder
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.geometry.se3 import se3_inverse, turn_covariance
from sigmaslam.progress import open_progress
from sigmaslam.readers import StereoSequence
from sigmaslam.readers.stereo_sequence import read_ahead
from sigmaslam.reconstruction.cloud import DenseCloud, DepthPixels, VoxelCloud, write_cloud
from sigmaslam.reconstruction.depth_fusion import SHARED, DepthView, FusedDepth, fuse_depth
from sigmaslam.reconstruction.disparity import DisparityMap, Matcher, measure_disparity, semi_global_disparity
from sigmaslam.reconstruction.mesh import DepthVolume, need_open3d
from sigmaslam.reconstruction.posed_images import PosedImages
from sigmaslam.reconstruction.recorded_keyframes import RecordedKeyframes, open_input, read_recorded_keyframes
from sigmaslam.reconstruction.stereo_network import StereoNetwork
from sigmaslam.report.report import write_report
from sigmaslam.run_record.dense_points import DENSE_NAME, RECONSTRUCTION_NAME, write_dense_points
from sigmaslam.slam.frame import usable_pixels

NEIGHBOURS = 2
"""Views before, and behind, that a keyframe's depths are fused with."""
MIN_VIEWS = 2
"""Keyframes that a point of the cloud needs, half as many as there are at the most."""
# Points less certain than this share of their depth are left out.
_MAX_SIGMA = 0.05
# Of the window around a point, pixels, this share must be points, too. Borders of what is measured, where foregrounds
# are too wide, hold a half (rooms: a third) of the gross errors of rendered streets and a tenth of their points.
_SURROUNDINGS, _LEAST_POINTS = 13, 0.6
# Side of the finest voxels, in pixels at the median depth of the first keyframe.
_VOXEL_PIXELS = 2.0
_NumberedView = tuple[int, np.ndarray, DepthView]


@dataclass(frozen=True, slots=True)
class ReconstructionSummary:
    """What was made.

    Attributes:
        keyframes: how many of the run.
        points: of the cloud.
        voxel: side of the finest ones, metres.
        measured: share of the pixels that have a disparity.
        confirmed: share of the pixels with a disparity that another keyframe confirms, and that became points.
        median_sigma: of the points, root of the largest eigenvalue of their covariance, metres.
        seconds_a_keyframe: wall time, reading images included.
    """

    keyframes: int
    points: int
    voxel: float
    measured: float
    confirmed: float
    median_sigma: float
    seconds_a_keyframe: float


@dataclass(frozen=True)
class KeyframeDepth:
    """The depths of one keyframe.

    Attributes:
        number: of the keyframe in its run.
        picture: (H, W, 3) uint8 red, green and blue of the rectified left image.
        measured: its own disparities, with the disparity offset taken off.
        fused: the same after fusion.
        pose: (4, 4) T_world_rectified.
        pose_covariance: (6, 6) in the rectified camera's frame, translation (metres) before rotation (radians).
        offset_sigma: of the disparity offset, pixels: an error that all disparities have in common.
    """

    number: int
    picture: np.ndarray
    measured: DisparityMap
    fused: FusedDepth
    pose: np.ndarray
    pose_covariance: np.ndarray
    offset_sigma: float

    @property
    def variance(self) -> np.ndarray:
        """(H, W) of the fused disparities, that of the offset included; pixels squared."""
        return np.asarray(self.fused.variance + np.float32(self.offset_sigma**2))

    @cached_property
    def is_point(self) -> np.ndarray:
        """(H, W) bool: confirmed, near enough to be certain, and among others that are."""
        certain = self.fused.is_confirmed & (self.variance < (_MAX_SIGMA * self.fused.disparity) ** 2)
        share = cv2.blur(certain.astype(np.float32), (_SURROUNDINGS, _SURROUNDINGS))
        return np.asarray(certain & (share > _LEAST_POINTS))

    def cloud(self, camera: RectifiedStereo, voxel: float) -> tuple[DenseCloud, np.ndarray]:
        """The points in the world, about one a voxel of that side, metres; and their sigmas (N,) by the depth alone."""
        pixels = DepthPixels.of(self.fused.disparity, self.variance, self.picture, self.is_point)
        pixels = pixels.thinned(camera, voxel)
        return pixels.cloud(camera, self.pose, self.pose_covariance), pixels.sigma(camera)


def reconstruct_run(
    run: Path,
    out: Path,
    mesh: Path | None = None,
    moved_to: Path | None = None,
    network: Path | None = None,
    voxel: float | None = None,
    max_sigma: float | None = None,
    min_views: int | None = None,
    every: int = 1,
    export: Path | None = None,
) -> ReconstructionSummary:
    """Reconstructs what the keyframes of a run saw; the report of the run shows the cloud, too.

    Args:
        run: folder of `sigmaslam track`.
        out: PLY file of the cloud.
        mesh: PLY file of a mesh; needs Open3D.
        moved_to: where the run's input is, if it has moved.
        network: ONNX file of a stereo network in place of semi-global matching.
        voxel: side of the finest voxels that points are merged in, metres; None: two pixels at the median depth.
        max_sigma: points with a larger sigma are left out, metres; None: with one of a twentieth of their distance.
        min_views: as many pixels must have given a point, of other keyframes as a rule; by default two.
        every: of so many keyframes one is used.
        export: folder for images and poses in the forms of nerfstudio and COLMAP.
    Raises:
        InputError: something is missing or wrong; all of that is looked for before the work begins.
    """
    for path in (out, mesh):
        _check_writable(path)
    if mesh is not None:
        need_open3d()
    if export is not None:
        check_new_folder(export, "--export")
    keyframes = read_recorded_keyframes(run, every)
    sequence = open_input(keyframes, moved_to)
    match: Matcher = semi_global_disparity if network is None else StereoNetwork(network)
    rectifier = StereoRectifier(keyframes.camera)
    camera = rectifier.rectified
    cloud: VoxelCloud | None = None
    volume: DepthVolume | None = None
    posed = None if export is None else PosedImages(export, camera)
    measured = confirmed = 0
    began = time.perf_counter()
    with open_progress() as progress:
        task = progress.add_task("keyframes", total=keyframes.count, note="")
        for depth in fuse_keyframes(keyframes, sequence, rectifier, match):
            chosen = depth.is_point
            if cloud is None:
                cloud = VoxelCloud(voxel or default_voxel(depth, camera))
                volume = None if mesh is None else DepthVolume(cloud.size, camera)
            cloud.add(*depth.cloud(camera, cloud.size))
            if posed is not None:
                posed.add(depth.picture, depth.pose)
            if volume is not None:
                z = np.where(chosen, camera.focal_baseline / np.where(chosen, depth.fused.disparity, 1.0), 0.0)
                volume.integrate(z.astype(np.float32), depth.picture, depth.pose)
            measured += int(np.isfinite(depth.measured.disparity).sum())
            confirmed += int(chosen.sum())
            progress.update(task, advance=1, note=f"{confirmed / max(measured, 1):.0%} confirmed")
    seconds = time.perf_counter() - began
    assert cloud is not None
    points = cloud.cloud(least_views(keyframes.count) if min_views is None else min_views)
    if not len(points):
        raise InputError("no point is left: give a smaller --min-views")
    if max_sigma is not None and max_sigma < (least := float(points.sigma.min())):
        raise InputError(f"--max-sigma is {max_sigma:g} m, and no point is known to less than {least:.2g} m")
    points = points.select(points.sigma <= (max_sigma or np.inf))
    write_cloud(out, points)
    if posed is not None:
        posed.write(points)
    if mesh is not None and volume is not None:
        volume.write(mesh)
    shares = measured / (keyframes.count * camera.width * camera.height), confirmed / max(measured, 1)
    others = float(np.median(points.sigma)), seconds / keyframes.count
    summary = ReconstructionSummary(keyframes.count, len(points), cloud.size, *shares, *others)
    _add_to_report(run, points, summary)
    return summary


def fuse_keyframes(
    keyframes: RecordedKeyframes, sequence: StereoSequence, rectifier: StereoRectifier, match: Matcher
) -> Iterator[KeyframeDepth]:
    """Depths of the keyframes, in order; images and disparities of a few of them are in memory at a time.

    Args:
        match: finds disparities to a pixel.
    """
    kept: dict[int, tuple[np.ndarray, DepthView]] = {}

    def views() -> Generator[_NumberedView, None, None]:
        for number, frame in keyframes.images(sequence):
            if (lower := keyframes.raised[number] - rectifier.raised) != 0.0:
                rectifier.raise_right(lower)
            left, right = rectifier.rectify(frame.left, frame.right)
            usable = usable_pixels(frame.mask, rectifier)
            view = measure_view(left, right, rectifier, match, keyframes.disparity_offset[number], usable)
            yield number, make_picture(left, frame.colour, rectifier), view

    for number, picture, view in read_ahead(views, 1):
        kept[number] = picture, view
        done = number - NEIGHBOURS
        if done >= 0 and keyframes.is_keyframe[done]:
            yield fuse_keyframe(done, kept, keyframes, rectifier)
        kept.pop(done - NEIGHBOURS, None)
    for number in range(max(len(keyframes) - NEIGHBOURS, 0), len(keyframes)):
        if keyframes.is_keyframe[number]:
            yield fuse_keyframe(number, kept, keyframes, rectifier)


def fuse_keyframe(
    number: int,
    views: Mapping[int, tuple[np.ndarray, DepthView]],
    keyframes: RecordedKeyframes,
    rectifier: StereoRectifier,
) -> KeyframeDepth:
    """Depths of a keyframe, fused with the views around it.

    Args:
        views: by their numbers, pictures and views; those around the keyframe that there are.
        keyframes: poses of the views.
    """
    T_left_rectified = se3_inverse(rectifier.T_rectified_left)
    picture, view = views[number]
    with np.errstate(invalid="ignore"):
        # Fusion does not take the common part away: what is too uncertain by that part alone becomes no point.
        hopeless = SHARED * view.measured.variance > (_MAX_SIGMA * view.measured.disparity) ** 2
    reference = replace(view.measured, disparity=np.where(hopeless, np.nan, view.measured.disparity))
    others = []
    # The nearest first: it says most of what is seen, and sets what the others must agree with.
    near = [k for k in views if 0 < abs(k - number) <= NEIGHBOURS]
    for other in sorted(near, key=lambda k: (abs(k - number), k)):
        step, covariance = keyframes.step(number, other)
        pose = rectifier.T_rectified_left @ step @ T_left_rectified
        others.append((views[other][1], pose, turn_covariance(rectifier.T_rectified_left, covariance)))
    return KeyframeDepth(
        number,
        picture,
        view.measured,
        fuse_depth(view.image.astype(np.uint8), reference, others, rectifier.rectified),
        keyframes.poses[number] @ T_left_rectified,
        turn_covariance(rectifier.T_rectified_left, keyframes.covariances[number]),
        float(keyframes.disparity_offset_sigma[number]),
    )


def make_picture(left: np.ndarray, colour: np.ndarray | None, rectifier: StereoRectifier) -> np.ndarray:
    """(H, W, 3) uint8 red, green and blue of a rectified left image (H, W), from its colours as they are stored."""
    if colour is None:
        return cv2.cvtColor(left, cv2.COLOR_GRAY2RGB)
    eye = rectifier.camera.left
    if colour.shape[:2] != (eye.height, eye.width):
        colour = cv2.resize(colour, (eye.width, eye.height), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(rectifier.rectify_left(colour), cv2.COLOR_BGR2RGB)


def measure_view(
    left: np.ndarray,
    right: np.ndarray,
    rectifier: StereoRectifier,
    match: Matcher,
    offset: float,
    usable: np.ndarray | None = None,
) -> DepthView:
    """The usable disparities of a rectified pair (H, W) uint8, not at its border, a disparity offset taken off."""
    measured = measure_disparity(left, right, match)
    disparity = measured.disparity - np.float32(offset)
    if rectifier.valid_mask is not None:
        disparity[cv2.erode(rectifier.valid_mask, np.ones((7, 7), np.uint8)) == 0] = np.nan
    if usable is not None:
        disparity[~usable] = np.nan
    return DepthView.of(left, replace(measured, disparity=disparity))


def default_voxel(depth: KeyframeDepth, camera: RectifiedStereo) -> float:
    """A few pixels at the median depth of a keyframe, of two digits, metres."""
    single = depth.measured.disparity
    known = depth.fused.disparity[depth.is_point] if depth.is_point.any() else single[single > 0.0]
    if not len(known):
        raise InputError("nothing was matched between the eyes in the first keyframe: give --voxel, or check the input")
    median = camera.focal_baseline / float(np.median(known))
    return float(f"{_VOXEL_PIXELS * median / camera.fx:.2g}")


def least_views(keyframes: int) -> int:
    """Keyframes that a point needs where there are so many."""
    return min(MIN_VIEWS, max(keyframes // 2, 1))


def _check_writable(path: Path | None) -> None:
    """The file can be made, as far as that is known before."""
    if path is None:
        return
    if path.suffix.lower() != ".ply":
        raise InputError(f"{path}: clouds and meshes are PLY files: give a name that ends in .ply")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist: create it, or choose another")


def _add_to_report(run: Path, points: DenseCloud, summary: ReconstructionSummary) -> None:
    """Leaves an even selection of the points, and the summary, in the run's folder and writes its report anew."""
    write_dense_points(run / DENSE_NAME, points.points, points.sigma, points.colours)
    atomic_write_json(run / RECONSTRUCTION_NAME, asdict(summary))
    write_report(run)
