"""A run in Rerun: images with tracks, path, frusta, points, ellipsoids and plots, on the time of the recording."""

import logging
import socket
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from sigmaslam.errors import OutputError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.se3 import matrix_to_quaternion, transform_points
from sigmaslam.live.frame_drawing import STATUS_COLOURS, MatchTrails, shade_matches
from sigmaslam.live.frame_sink import TrackedFrame
from sigmaslam.live.keyframe_points import KeyframePoints
from sigmaslam.slam.matched_frame import MatchedFrame

_LOGGER = logging.getLogger(__name__)
IMAGE, PATH, SIGMA, PLOTS = "world/camera/image", "world/path", "world/sigma", "plots"
CLOCK, FRAME = "time", "frame"
"""Timelines: of the recording, and numbers of frames."""
# The path is logged in pieces of so many poses, as each pose logs its piece anew.
_PIECE = 100
_QUALITY = 80
# Time stamps after 1973 are taken for those of a clock that counts from 1970, seconds.
_FIRST_DATE = 1e8
# Of the frustum of a keyframe: its depth as a share of the median depth of the points that it shows first.
_FRUSTUM = 0.05
# How long a run waits for a viewer to answer, and in the end to take the last frames, seconds.
_PATIENCE = 10.0
_PORT = 9876
"""Where viewers listen."""


class RerunSink:
    """Shows a run in a window, here or on another machine, or writes what a window would show.

    Args:
        target: path of an .rrd to write; URL of a viewer that is open; None: open a window.
        camera: of the raw images.

    Attributes:
        name: of the file, or of the viewer.
    Raises:
        OutputError: the window does not open, or no viewer answers.
    """

    def __init__(self, target: Path | str | None, camera: StereoCamera) -> None:
        self.name = str(target or "the viewer")
        self._path = target if isinstance(target, Path) else None
        self._trails, self._points = MatchTrails(), KeyframePoints(camera)
        self._positions: list[np.ndarray] = []
        self._colours: list[tuple[int, int, int]] = []
        self._depth, self._clouds = 1.0, 0
        self._recording = rr.RecordingStream("sigmaslam")
        self._is_open = False
        if self._path is not None:
            return
        try:
            if isinstance(target, str):
                place = urlsplit(target)
                socket.create_connection((place.hostname or "", place.port or _PORT), _PATIENCE).close()
                self._recording.connect_grpc(target, default_blueprint=_blueprint())
            else:
                self._recording.spawn(default_blueprint=_blueprint())
        except Exception as error:
            mend = "give rerun:FILE.rrd" if target is None else "start `rerun` there, and give what it listens on"
            raise OutputError(f"--viewer {target or 'rerun'}: no viewer answers ({error}); {mend}") from error
        self._begin()

    def add(self, frame: TrackedFrame) -> None:
        """Shows a frame."""
        if not self._is_open:
            assert self._path is not None
            self._recording.save(self._path, default_blueprint=_blueprint())
            self._begin()
        estimate = frame.result.camera
        recording = self._recording
        recording.set_time(FRAME, sequence=frame.number)
        if estimate.timestamp < _FIRST_DATE:
            recording.set_time(CLOCK, duration=estimate.timestamp)
        else:
            recording.set_time(CLOCK, timestamp=estimate.timestamp)
        recording.log("status", rr.TextLog(f"{estimate.status}, {estimate.inliers} inliers"))
        if frame.seen is not None:
            self._show_image(frame.seen)
        if estimate.has_pose:
            self._show_pose(frame)
        self._plot("inliers", estimate.inliers)
        self._plot("milliseconds", sum(estimate.milliseconds.values()))
        if estimate.dof:
            self._plot("nis_per_dof", estimate.nis / estimate.dof)

    def show_cloud(self, points: np.ndarray, colours: np.ndarray) -> None:
        """Shows points (N, 3) of a dense cloud, metres, with red, green and blue (N, 3) to 255, from now on."""
        self._clouds += 1
        cloud = rr.Points3D(points, colors=colours.astype(np.uint8))
        self._recording.log(f"world/dense/{self._clouds}", cloud, static=True)

    def close(self) -> None:
        """No frame comes any more. A window that was closed before is no error; a file that is not whole is."""
        try:
            if self._is_open:
                self._recording.flush(timeout_sec=_PATIENCE)
            self._recording.disconnect()
        except Exception as error:
            if self._path is not None:
                raise
            _LOGGER.warning("the viewer has not got all frames: %s", error)

    def _begin(self) -> None:
        """What does not change: the axes of the first camera, and its lens."""
        self._is_open = True
        camera = self._points.camera
        self._recording.log("world", rr.ViewCoordinates.RDF, static=True)
        matrix = camera.matrix + [[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]]  # as pixels below
        lens = rr.Pinhole(image_from_camera=matrix, resolution=[camera.width, camera.height])
        self._recording.log(IMAGE, lens, static=True)

    def _show_image(self, seen: MatchedFrame) -> None:
        _, encoded = cv2.imencode(".jpg", seen.left, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        self._recording.log(IMAGE, rr.EncodedImage(contents=encoded.tobytes(), media_type="image/jpeg"))
        self._trails.add(seen)
        rows, trails = self._trails.follow()
        colours = shade_matches(seen.matches.probability[rows])[:, ::-1]
        # Rerun has the origin in the corner of the first pixel, we in its centre.
        self._recording.log(f"{IMAGE}/trails", rr.LineStrips2D([trail + 0.5 for trail in trails], colors=colours))
        self._recording.log(f"{IMAGE}/matches", rr.Points2D(seen.pixels[rows] + 0.5, colors=colours, radii=2.5))
        outliers = seen.pixels[~seen.inliers] + 0.5
        self._recording.log(f"{IMAGE}/outliers", rr.Points2D(outliers, colors=[255, 77, 61], radii=2.0))

    def _show_pose(self, frame: TrackedFrame) -> None:
        estimate, recording = frame.result.camera, self._recording
        T, covariance = estimate.T_world_camera, estimate.covariance
        T_world_rectified = T @ self._points.T_left_rectified
        position = T[:3, 3]
        recording.log(
            "world/camera", rr.Transform3D(translation=T_world_rectified[:3, 3], mat3x3=T_world_rectified[:3, :3])
        )
        blue, green, red = STATUS_COLOURS[estimate.status]
        self._positions.append(position)
        self._colours.append((red, green, blue))
        self._show_path()
        variances, axes = np.linalg.eigh(covariance[:3, :3])
        axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])  # no mirror
        ellipsoid = rr.Ellipsoids3D(
            half_sizes=3.0 * np.sqrt(np.maximum(variances, 0.0))[None],
            centers=position[None],
            quaternions=matrix_to_quaternion(T[:3, :3] @ axes)[None],
            colors=[red, green, blue],
        )
        recording.log(SIGMA, ellipsoid)
        diagonal = np.diag(covariance)
        self._plot("sigma_position_m", float(np.sqrt(diagonal[:3].sum())))
        self._plot("sigma_rotation_deg", float(np.degrees(np.sqrt(diagonal[3:].sum()))))
        if (inertial := estimate.inertial) is not None:
            self._plot("level_deg/roll", float(np.degrees(inertial.roll)))
            self._plot("level_deg/pitch", float(np.degrees(inertial.pitch)))
            for name in ("gyro_bias", "accel_bias"):
                for axis, value in zip("xyz", getattr(inertial, name).tolist(), strict=True):
                    self._plot(f"{name}/{axis}", value)
        if estimate.tracks is not None:
            self._show_keyframe(frame, T_world_rectified)

    def _show_path(self) -> None:
        """The piece of the path that the last pose ends, a line a step, in the colour of the pose at its end."""
        last = len(self._positions) - 1
        piece = max(last - 1, 0) // _PIECE
        first = piece * _PIECE
        steps = [self._positions[k : k + 2] for k in range(first, last)]
        self._recording.log(f"{PATH}/{piece}", rr.LineStrips3D(steps, colors=self._colours[first + 1 : last + 1]))

    def _show_keyframe(self, frame: TrackedFrame, T_world_rectified: np.ndarray) -> None:
        """The frustum of a keyframe, and the points that it is the first to show."""
        points, grey = self._points.add(frame)
        if len(points):
            colours = np.repeat(grey[:, None], 3, axis=1)
            self._recording.log(f"world/points/{frame.number}", rr.Points3D(points, colors=colours))
            self._depth = float(np.median(np.linalg.norm(points - T_world_rectified[:3, 3], axis=1)))
        camera = self._points.camera
        width, height = camera.width - 1, camera.height - 1
        corners = camera.rays(np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]], np.float64))
        base = transform_points(T_world_rectified, _FRUSTUM * self._depth * corners)
        sides = [np.stack([T_world_rectified[:3, 3], corner]) for corner in base[:4]]
        self._recording.log(f"world/keyframes/{frame.number}", rr.LineStrips3D([base, *sides], colors=[127, 214, 179]))

    def _plot(self, name: str, value: float) -> None:
        self._recording.log(f"{PLOTS}/{name}", rr.Scalars(value))


def _blueprint() -> rrb.Blueprint:
    """The world beside the image and the plots."""
    names = ["sigma_position_m", "sigma_rotation_deg", "nis_per_dof", "inliers", "milliseconds"]
    names += ["level_deg", "gyro_bias", "accel_bias"]  # of an inertial sensor
    plots = [rrb.TimeSeriesView(origin=f"{PLOTS}/{name}", name=name.replace("_", " ")) for name in names]
    world = rrb.Spatial3DView(origin="world", name="world")
    image = rrb.Spatial2DView(origin=IMAGE, name="left image")
    return rrb.Blueprint(
        rrb.Horizontal(world, rrb.Vertical(image, rrb.Tabs(*plots), row_shares=[2, 1])), collapse_panels=True
    )
