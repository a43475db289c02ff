"""A run as a web page while it goes on, read-only: picture, path, pose and verdict for those without a viewer."""

import json
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cv2

from sigmaslam.errors import InputError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.live.estimate_stream import describe_estimate
from sigmaslam.live.frame_drawing import FramePainter
from sigmaslam.live.frame_sink import TrackedFrame
from sigmaslam.slam.estimate import CalibrationEstimate

_HERE = frozenset({"127.0.0.1", "localhost"})
# Seconds between two pictures at least, however many look: drawing takes a core 10 to 20 ms.
_INTERVAL = 0.2
_QUALITY = 80
# Frames that the rate is the mean of, and seconds after which a client that says nothing is left.
_RATED, _PATIENCE = 20, 10.0
# Seconds that the end of a run waits for the server at most.
_POLL = 0.1
Answer = Callable[[str], tuple[str, bytes] | None]
"""Type and content of what is at a path; None where nothing is."""
Judge = Callable[[CalibrationEstimate, Counter[str], int], str]
"""Says a verdict on the calibration, from its estimate, the frames of each status, and the number of points."""


class WebPageSink:
    """Serves a page over the newest frame; nothing is drawn while nobody looks.

    Args:
        address: `PORT` of this machine alone, `HOST:PORT` or `[::1]:PORT`; port 0 takes a free one.
        camera: of the raw images.

    Attributes:
        name: for messages.
        url: of the page.
    Raises:
        InputError: the address is none, or another program has it.
    """

    name = "the web page"

    def __init__(self, address: str, camera: StereoCamera, judge: Judge) -> None:
        host, _, port = address.rpartition(":")
        host = host.removeprefix("[").removesuffix("]") or "127.0.0.1"
        if not port.isascii() or not port.isdigit() or int(port) > 65535:
            raise InputError(f"--serve {address}: is no address; give a PORT as 8000, HOST:PORT or [::1]:PORT")
        try:
            # A page of another site that names itself as this machine must not read the pictures.
            handler = partial(_Handler, self._answer, _HERE | {host} if host in (*_HERE, "::1") else None)
            self._server = (_ServerOfVersion6 if ":" in host else ThreadingHTTPServer)((host, int(port)), handler)
        except OSError as error:
            raise InputError(
                f"--serve {address}: {error.strerror}; give another HOST or PORT; port 0 is a free one"
            ) from None
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{self._server.server_port}/"
        self._painter, self._judge = FramePainter(camera), judge
        self._lock = threading.Lock()
        self._frame: TrackedFrame | None = None
        self._statuses = Counter[str]()
        self._times = deque[float](maxlen=_RATED)
        self._picture, self._drawn = b"", -_INTERVAL
        threading.Thread(target=self._server.serve_forever, args=(_POLL,), name="sigmaslam-page", daemon=True).start()

    def add(self, frame: TrackedFrame) -> None:
        """Takes a frame."""
        with self._lock:
            self._painter.add(frame)
            self._frame = frame
            self._statuses[frame.result.camera.status] += 1
            self._times.append(time.monotonic())

    def close(self) -> None:
        """No frame comes any more: the page says that the run has ended."""
        self._server.shutdown()
        self._server.server_close()

    def _answer(self, path: str) -> tuple[str, bytes] | None:
        if path == "/":
            return "text/html; charset=utf-8", Path(__file__).with_name("web_page.html").read_bytes()
        if path not in ("/state.json", "/picture.jpg"):
            return None
        with self._lock:
            if path == "/state.json":
                return "application/json", json.dumps(self._describe(), allow_nan=False).encode("ascii")
            return None if self._frame is None else ("image/jpeg", self._draw())

    def _describe(self) -> dict[str, Any]:
        """The newest frame as a stream has it, frames by status and a second, and the verdict."""
        if self._frame is None:
            return {"frame": None}
        calibration = self._frame.result.camera.calibration
        elapsed = self._times[-1] - self._times[0]
        return {
            **describe_estimate(self._frame),
            "frames_a_second": (len(self._times) - 1) / elapsed if elapsed > 0.0 else None,
            "statuses": dict(self._statuses),
            "verdict": self._judge(calibration, self._statuses, self._painter.plan.count),
        }

    def _draw(self) -> bytes:
        """The newest frame, or the last one drawn where that is a moment ago."""
        now = time.monotonic()
        if now - self._drawn >= _INTERVAL:
            self._drawn = now
            _, encoded = cv2.imencode(".jpg", self._painter.draw(), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
            self._picture = encoded.tobytes()
        return self._picture


class _ServerOfVersion6(ThreadingHTTPServer):
    address_family = socket.AF_INET6


class _Handler(BaseHTTPRequestHandler):
    timeout = _PATIENCE
    server_version, sys_version = "SigmaSLAM", ""

    def __init__(self, answer: Answer, hosts: frozenset[str] | None, *request: Any) -> None:
        self._answer, self._hosts = answer, hosts
        with suppress(OSError, ValueError):  # a client that has gone, or talks nonsense
            super().__init__(*request)

    def do_GET(self) -> None:
        host = urlsplit(f"//{self.headers.get('Host', '')}").hostname
        if self._hosts is not None and host not in self._hosts:
            self.send_error(403)
        elif (found := self._answer(urlsplit(self.path).path)) is None:
            self.send_error(404)
        else:
            self._send(200, *found)

    def __getattr__(self, name: str) -> Callable[[], None]:
        """Every method but GET is refused."""
        if not name.startswith("do_"):
            raise AttributeError(name)
        return lambda: self._send(405, "text/plain", b"only GET is answered\n")

    def log_message(self, *_: Any) -> None:
        """Requests are not told of."""

    def _send(self, code: int, kind: str, content: bytes) -> None:
        self.send_response(code)
        headers = {"Content-Type": kind, "Content-Length": len(content), "Cache-Control": "no-store", "Allow": "GET"}
        for name, value in headers.items():
            self.send_header(name, str(value))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)
