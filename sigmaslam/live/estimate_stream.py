"""Estimates as lines of JSON while a run goes on: to the standard output, or as UDP datagrams."""

import json
import logging
import os
import queue
import socket
import sys
import threading
from typing import Any, BinaryIO
from urllib.parse import urlsplit

import numpy as np

from sigmaslam.bodies.object_tracker import ObjectEstimate
from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import matrix_to_quaternion
from sigmaslam.live.frame_sink import TrackedFrame

_LOGGER = logging.getLogger(__name__)
# Lines that wait for a slow reader; when there are more, the newest ones are dropped.
_WAITING = 10_000


def describe_estimate(frame: TrackedFrame) -> dict[str, Any]:
    """What was said of a frame, as JSON has it; null before there is a pose.

    Returns:
        `time` (seconds), `frame` (number of the row in frames.csv), `status`, `doubts`, the pose `T_world_camera`, or
        `T_camera_object` of a followed body, as `position` (metres) and `quaternion_xyzw`, `covariance` (6, 6) of it in
        its own frame, translation (metres) before rotation (radians), `belief`, `matches`, `inliers`, `nis`, `dof` and
        `disparity_offset` (pixels) as of `Estimate`, and `keyframe`, whether the frame became one. Where
        an inertial sensor knows gravity also `roll`, `pitch` and `roll_pitch_sigma`, radians.
    """
    result, camera = frame.result, frame.result.camera
    pose = covariance = None
    if camera.has_pose:
        quaternion = matrix_to_quaternion(result.pose[:3, :3])
        pose = {"position": result.pose[:3, 3].tolist(), "quaternion_xyzw": quaternion.tolist()}
        if np.isfinite(result.pose_covariance).all():
            covariance = result.pose_covariance.tolist()
    up = camera.inertial
    level = {} if up is None else {"roll": up.roll, "pitch": up.pitch, "roll_pitch_sigma": list(up.sigmas)}
    return {
        "time": round(camera.timestamp, 9),
        "frame": frame.number,
        "status": camera.status,
        "doubts": list(camera.doubts),
        "T_camera_object" if isinstance(result, ObjectEstimate) else "T_world_camera": pose,
        "covariance": covariance,
        "belief": _finite(camera.belief),
        "matches": camera.matches,
        "inliers": camera.inliers,
        "nis": _finite(camera.nis),
        "dof": camera.dof,
        "disparity_offset": _finite(camera.calibration.disparity_offset),
        "keyframe": camera.tracks is not None,
        **level,
    }


def format_estimate(frame: TrackedFrame) -> bytes:
    """`describe_estimate` as one line."""
    return json.dumps(describe_estimate(frame), allow_nan=False).encode("ascii") + b"\n"


def open_stream(target: str) -> "PipeStream | UdpStream":
    """The stream that the command line names.

    Args:
        target: `stdout`, or `udp://HOST:PORT`.
    Raises:
        InputError: it is neither, or there is no such host.
    """
    if target == "stdout":
        return PipeStream(os.fdopen(os.dup(sys.stdout.fileno()), "wb", buffering=0))
    try:
        url = urlsplit(target)
        host, port = url.hostname, url.port
    except ValueError as error:
        raise InputError(f"--stream {target}: {error}; give stdout, or udp://HOST:PORT") from None
    if url.scheme != "udp" or not host or not port or url.path or url.query:
        raise InputError(f"--stream {target}: is no stream; give stdout, or udp://HOST:PORT as udp://127.0.0.1:5005")
    return UdpStream(host, port)


class PipeStream:
    """A line a frame into a pipe or a file, written in a thread: a reader that is slow or gone does not stop the run.

    Args:
        file: without a buffer, so that a line is there when it is written.

    Attributes:
        name: for messages.
        is_broken: nobody reads the pipe any more; what came since is dropped.
    """

    name = "the stream"

    def __init__(self, file: BinaryIO) -> None:
        self.is_broken = False
        self._file = file
        self._queue: queue.Queue[bytes | None] = queue.Queue()
        self._dropped = 0
        self._thread = threading.Thread(target=self._run, name="sigmaslam-stream", daemon=True)
        self._thread.start()

    def add(self, frame: TrackedFrame) -> None:
        """Takes a frame."""
        if self.is_broken:
            return
        if self._queue.qsize() < _WAITING:
            self._queue.put(format_estimate(frame))
        else:
            self._dropped += 1

    def close(self) -> None:
        """No frame comes any more."""
        self._queue.put(None)

    def wait(self, seconds: float | None) -> None:
        """Waits, after `close`, until the reader has every line, for at most so long; None: as long as it lives."""
        self._thread.join(seconds)
        dropped = self._dropped + max(self._queue.qsize() - 1, 0)
        if dropped and not self.is_broken:
            _LOGGER.warning("--stream: the reader is too slow, %d lines were dropped", dropped)

    def _run(self) -> None:
        while (line := self._queue.get()) is not None:
            rest = memoryview(line)
            try:
                while rest:
                    rest = rest[self._file.write(rest) :]
            except OSError as error:
                if not isinstance(error, BrokenPipeError):
                    _LOGGER.error("--stream: cannot be written (%s)", error.strerror)
                self.is_broken = True
                return


class UdpStream:
    """A datagram a frame, whether anyone receives it or not.

    Attributes:
        name: for messages.
    Raises:
        InputError: there is no such host.
    """

    name = "the stream"

    def __init__(self, host: str, port: int) -> None:
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except (OSError, UnicodeError) as error:
            raise InputError(f"--stream udp://{host}:{port}: {error}; name a host that there is") from None
        self._address: Any = address  # its form is the family's
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setblocking(False)
        self._unsent = 0

    def add(self, frame: TrackedFrame) -> None:
        """Sends a frame."""
        try:
            self._socket.sendto(format_estimate(frame), self._address)
        except OSError:  # no network, or its buffer is full
            self._unsent += 1

    def close(self) -> None:
        """No frame comes any more."""
        self._socket.close()
        if self._unsent:
            _LOGGER.warning("--stream: %d datagrams could not be sent", self._unsent)


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
