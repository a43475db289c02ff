"""The peers by name; other people's stereo odometry, driven as its documentation has it, on rectified pairs.

cuVSLAM by the package `dim-odom`, on the CPU; ORB-SLAM3 by the package `pyorbslam3`. ORB-SLAM3 is under the GPL and
cuVSLAM under NVIDIA's Community License: both are peers to compare with while SigmaSLAM is developed, nothing else
imports them. They come with the extra `peers`.
"""

import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import replace
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.errors import SigmaSlamError
from sigmaslam.geometry.camera import RectifiedStereo, StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.geometry.se3 import quaternion_to_matrix, turn_covariance
from sigmaslam.readers import StereoSequence
from sigmaslam_benchmarks.tracking.peer_run import Peer, PeerStep, write_peer_run

RECTIFIED = ("cuvslam", "orbslam3")
"""Peers that take rectified pairs."""
PEERS = {"klt-pnp": "klt", "sift-pnp": "sift", **dict.fromkeys(RECTIFIED, "")}
"""All peers, with the matcher of those from OpenCV."""
_NO_TURN = (0.0, 0.0, 0.0, 1.0)
# As in ORB-SLAM3's own settings for EuRoC and for KITTI.
_WIDE, _ORB_KEYPOINTS, _ORB_KEYPOINTS_WIDE = 1000, 1200, 2000
_ORB_SETTINGS = Path(__file__).with_name("orbslam3.yaml")


class MissingPeerError(SigmaSlamError):
    """A peer, or something that it needs, is not installed."""


class CuvslamPeer:
    """cuVSLAM, stereo, without a GPU.

    Args:
        camera: of the rectified pairs.
    Raises:
        MissingPeerError: the package or a library that it loads is not installed.
    """

    def __init__(self, camera: RectifiedStereo) -> None:
        try:
            import dim_odom
        except ImportError as error:
            raise _not_installed("dim_odom", error) from error
        self.version = f"dim-odom {version('dim-odom')}"
        self._package, self._camera = dim_odom, camera
        # The body frame that it asks for is the left camera's.
        self._places = {"base_link": 0.0, "left": 0.0, "right": camera.baseline}
        self._tracker = dim_odom.CuvslamOdometry({"camera_mode": "stereo", "use_gpu": False}, tf=self._mount)
        matrix = camera.matrix.ravel().tolist()
        for eye in ("left", "right"):
            self._tracker.handle_camera_info(
                dim_odom.CameraModel(0, eye, camera.width, camera.height, [0.0] * 5, matrix)
            )

    def step(self, left: np.ndarray, right: np.ndarray, timestamp: float) -> PeerStep:
        """The pose of a rectified pair (H, W) uint8, with the covariance that it gives; without one it is lost."""
        estimate = None
        for eye, image in (("left", left), ("right", right)):
            height, width = image.shape
            frame = self._package.ImageFrame(
                round(1e9 * timestamp), eye, width, height, "mono8", width, image.tobytes()
            )
            estimate = self._tracker.handle_image(frame)
        if estimate is None:
            return PeerStep(None, "lost")
        pose = np.eye(4)
        pose[:3, :3] = quaternion_to_matrix(np.array(estimate.rotation_xyzw))
        pose[:3, 3] = estimate.translation
        covariance = body_covariance(np.reshape(estimate.pose_covariance, (6, 6)), pose[:3, :3])
        return PeerStep(pose, "tracking", covariance=covariance)

    def close(self) -> None:
        """It needs no end."""

    def _mount(self, parent: str, child: str) -> tuple[tuple[float, float, float], tuple[float, ...]] | None:
        if parent not in self._places or child not in self._places:
            return None
        return (self._places[child] - self._places[parent], 0.0, 0.0), _NO_TURN


class OrbSlamPeer:
    """ORB-SLAM3, stereo, without a viewer; its mapping and loop closure run in threads of their own.

    One alone in a process: a second one would go on with the camera of the first, which it keeps in static variables.

    Args:
        camera: of the rectified pairs.
        rate: frames per second.
    Raises:
        MissingPeerError: the package or its vocabulary is not there.
    """

    def __init__(self, camera: RectifiedStereo, rate: float) -> None:
        try:
            import pyorbslam3
        except ImportError as error:
            raise _not_installed("pyorbslam3", error) from error
        self.version = f"pyorbslam3 {version('pyorbslam3')}"
        try:
            vocabulary = pyorbslam3.vocabulary_path(download=False)
        except FileNotFoundError as error:
            raise MissingPeerError(
                "its vocabulary is not here: call `pyorbslam3.vocabulary_path()` once, which loads it, or make one by "
                "python -m sigmaslam_benchmarks.tracking.orb_vocabulary and set PYORBSLAM3_VOCAB to it"
            ) from error
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "settings.yaml"
            path.write_text(orb_settings(camera, rate), encoding="utf-8")
            self._slam: Any = pyorbslam3.Slam(vocabulary, path, pyorbslam3.Sensor.STEREO, use_viewer=False)

    def step(self, left: np.ndarray, right: np.ndarray, timestamp: float) -> PeerStep:
        """The pose of a rectified pair (H, W) uint8; without one it is lost."""
        result = self._slam.track_stereo(left, right, timestamp)
        return (
            PeerStep(np.array(result.pose_wc, np.float64), "tracking") if result.pose_valid else PeerStep(None, "lost")
        )

    def close(self) -> None:
        """Ends its threads."""
        self._slam.shutdown()


class OrbSlamProcess:
    """ORB-SLAM3 in a process of its own; arguments and errors as of `OrbSlamPeer`."""

    def __init__(self, camera: RectifiedStereo, rate: float) -> None:
        self._process = ProcessPoolExecutor(1, get_context("spawn"))
        self.version = self._process.submit(_start_orbslam, camera, rate).result()

    def step(self, left: np.ndarray, right: np.ndarray, timestamp: float) -> PeerStep:
        """The pose of a rectified pair (H, W) uint8; without one it is lost.

        Raises:
            BrokenProcessPool: it crashed.
        """
        return self._process.submit(_step_orbslam, left, right, timestamp).result()

    def close(self) -> None:
        """Ends it."""
        self._process.submit(_close_orbslam).result()
        self._process.shutdown()


_of_this_process: list[OrbSlamPeer] = []


def _start_orbslam(camera: RectifiedStereo, rate: float) -> str:
    _of_this_process.append(OrbSlamPeer(camera, rate))
    return _of_this_process[0].version


def _step_orbslam(left: np.ndarray, right: np.ndarray, timestamp: float) -> PeerStep:
    return _of_this_process[0].step(left, right, timestamp)


def _close_orbslam() -> None:
    _of_this_process[0].close()


def orb_settings(camera: RectifiedStereo, rate: float) -> str:
    """The settings file of ORB-SLAM3 for rectified pairs.

    It is in the older of its two forms: with the newer one, `Camera.type: "Rectified"`, pyorbslam3 0.1.1 crashes.
    It asks for the viewer's settings also where there is no viewer.
    """
    keypoints = _ORB_KEYPOINTS_WIDE if camera.width > _WIDE else _ORB_KEYPOINTS
    names = ("fx", "fy", "cx", "cy", "focal_baseline")
    return _ORB_SETTINGS.read_text(encoding="utf-8").format(
        **{name: float(getattr(camera, name)) for name in names},
        width=camera.width,
        height=camera.height,
        rate=float(rate),
        keypoints=keypoints,
    )


def body_covariance(covariance: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """A covariance as ROS and cuVSLAM give it, as one of an error in the body's own frame.

    Args:
        covariance: (6, 6) of x, y, z in the world (metres) and of roll, pitch, yaw about its fixed axes (radians), as
            `PoseWithCovariance` of cuVSLAM's header cuvslam2.h documents its `covariance_xyz_rpy`.
        rotation: (3, 3) R_world_body = Rz(yaw) Ry(pitch) Rx(roll).
    Returns:
        (6, 6), translation before rotation.
    """
    roll, pitch = np.arctan2(rotation[2, 1], rotation[2, 2]), -np.arcsin(rotation[2, 0])
    to_body = np.zeros((6, 6))
    to_body[:3, :3] = rotation.T
    # Rates of the angles as a rate of turn about the body's axes.
    to_body[3:, 3:] = [
        [1.0, 0.0, -np.sin(pitch)],
        [0.0, np.cos(roll), np.sin(roll) * np.cos(pitch)],
        [0.0, -np.sin(roll), np.cos(roll) * np.cos(pitch)],
    ]
    return np.asarray(to_body @ covariance @ to_body.T)


class _RectifyingPeer:
    """A peer that takes rectified pairs, given raw ones; poses are of the left camera as calibrated."""

    def __init__(self, rectifier: StereoRectifier, peer: Peer) -> None:
        self._rectifier, self._peer, self.version = rectifier, peer, peer.version
        self._T_left_rectified = np.eye(4)
        self._T_left_rectified[:3, :3] = rectifier.R_rectified_left.T

    def step(self, left: np.ndarray, right: np.ndarray, timestamp: float) -> PeerStep:
        """As of the peer."""
        found = self._peer.step(*self._rectifier.rectify(left, right), timestamp)
        if found.T_world_camera is None:
            return found
        T = self._T_left_rectified
        covariance = None if found.covariance is None else turn_covariance(T, found.covariance)
        return replace(found, T_world_camera=T @ found.T_world_camera @ T.T, covariance=covariance)

    def close(self) -> None:
        """As of the peer."""
        self._peer.close()


def open_peer(
    name: str, camera: StereoCamera | RectifiedStereo, timestamps: Sequence[float] | None, own_process: bool = True
) -> Peer:
    """A peer by its name.

    Args:
        name: of `PEERS`.
        camera: of the pairs; those in `RECTIFIED` also take rectified ones.
        timestamps: of the pairs, seconds; `orbslam3` asks for their rate.
        own_process: `orbslam3` runs in a process of its own; without it, it must be the only one of this process.
    Raises:
        MissingPeerError: it is not installed.
    """
    if name not in RECTIFIED:
        from sigmaslam_benchmarks.tracking.pnp_baselines import PnpOdometry  # start-up of the others does not count it

        assert isinstance(camera, StereoCamera)
        return PnpOdometry(camera, PEERS[name])
    if isinstance(camera, StereoCamera):
        rectifier = StereoRectifier(camera)
        return _RectifyingPeer(rectifier, open_peer(name, rectifier.rectified, timestamps, own_process))
    if name == "cuvslam":
        return CuvslamPeer(camera)
    assert timestamps is not None
    orbslam = OrbSlamProcess if own_process else OrbSlamPeer
    return orbslam(camera, 1.0 / float(np.median(np.diff(timestamps))))


def track_with_peer(sequence: StereoSequence, out: Path, name: str) -> None:
    """Tracks a sequence with a peer of `PEERS` into the new folder `out`, see `write_peer_run`.

    ORB-SLAM3 is given frames as fast as their time stamps say: its mapping runs beside them, and would fall behind.

    Raises:
        MissingPeerError: it is not installed.
        BrokenProcessPool: ORB-SLAM3 crashed.
    """
    with closing(open_peer(name, sequence.camera, sequence.timestamps)) as peer:
        write_peer_run(sequence, out, peer, live=name == "orbslam3")


def _not_installed(module: str, error: ImportError) -> MissingPeerError:
    """Says what is missing: the package, or a library that it loads."""
    if isinstance(error, ModuleNotFoundError) and error.name == module:
        return MissingPeerError(f"{module} is not installed: pip install 'sigmaslam[peers]'")
    return MissingPeerError(f"{module} cannot be imported ({error}): pip install 'sigmaslam[peers]'")
