"""The web page of a run is over the newest frame, changes nothing, and reaches nobody who was not asked in."""

import http.client
import json
import os
import socket
import threading
from collections import Counter
from collections.abc import Iterator
from html.parser import HTMLParser
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.live.frame_drawing import FramePainter
from sigmaslam.live.web_page import WebPageSink
from sigmaslam.readers import open_sequence
from sigmaslam.readers.selection import Selection
from sigmaslam.runs.request import LiveOptions
from sigmaslam.slam.estimate import CalibrationEstimate
from tests.support.commands import assert_refused, run_here
from tests.support.recorded_runs import frame_at
from tests.support.tracked import track

METHODS = ("POST", "PUT", "DELETE", "PATCH", "HEAD", "OPTIONS", "BREW")
PATHS = ("/", "/state.json", "/picture.jpg")
FRAMES = 12


def judge(calibration: CalibrationEstimate, statuses: Counter[str], points: int) -> str:
    return f"{calibration.disparity_offset} {statuses.total()} {points}"


@pytest.fixture
def camera(demo_sequence: Path) -> StereoCamera:
    return open_sequence(demo_sequence).camera


@pytest.fixture
def page(camera: StereoCamera) -> Iterator[WebPageSink]:
    opened = WebPageSink("0", camera, judge)
    yield opened
    opened.close()


def ask(page: WebPageSink, path: str, method: str = "GET", host: str | None = None) -> tuple[HTTPResponse, bytes]:
    address = page.url.split("/")[2]
    connection = HTTPConnection(address, timeout=10)
    connection.request(method, path, b"lost" if method == "POST" else None, {"Host": host or address})
    response = connection.getresponse()
    return response, response.read()


def state_of(page: WebPageSink) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(ask(page, "/state.json")[1])
    return found


def picture_of(page: WebPageSink) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(ask(page, "/picture.jpg")[1], np.uint8), cv2.IMREAD_COLOR)


def test_a_page_before_the_first_frame_waits(page: WebPageSink):
    assert state_of(page) == {"frame": None}
    assert ask(page, "/picture.jpg")[0].status == 404
    assert ask(page, "/?again")[1].startswith(b"<!doctype html>")


def test_state_and_picture_are_of_the_newest_frame(page: WebPageSink, camera: StereoCamera):
    painter = FramePainter(camera)
    for number, status in enumerate(("starting", "tracking", "lost")):
        frame = frame_at(number, np.eye(4), status)
        page.add(frame)
        painter.add(frame)
    state = state_of(page)
    assert (state["frame"], state["status"], state["statuses"]["lost"]) == (2, "lost", 1)
    assert state["verdict"] == f"{frame.result.camera.calibration.disparity_offset} 3 0"
    assert state["frames_a_second"] > 0
    difference = picture_of(page).astype(float) - painter.draw()
    assert np.sqrt(np.mean(difference**2)) < 12  # noise, in JPEG


def test_nothing_is_drawn_until_one_asks_and_then_a_few_times_a_second(
    page: WebPageSink, monkeypatch: pytest.MonkeyPatch
):
    drawn = []
    draw = FramePainter.draw
    monkeypatch.setattr(FramePainter, "draw", lambda self: drawn.append(1) or draw(self))  # type: ignore[func-returns-value]
    monkeypatch.setattr("sigmaslam.live.web_page._INTERVAL", 60.0)
    for number in range(5):
        page.add(frame_at(number, np.eye(4)))
    state_of(page)
    assert not drawn
    assert np.array_equal(picture_of(page), picture_of(page))
    assert len(drawn) == 1


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("path", PATHS)
def test_only_reading_is_allowed(page: WebPageSink, method: str, path: str):
    page.add(frame_at(0, np.eye(4)))
    before = state_of(page)
    response, content = ask(page, path, method)
    assert (response.status, response.headers["Allow"]) == (405, "GET")
    assert b"GET" in content or method == "HEAD"
    assert state_of(page) == before


@pytest.mark.parametrize(
    "path", ["/state", "/../web_page.py", "/web_page.html", "/%2e%2e/run.json", "//etc/passwd", "*"]
)
def test_other_paths_do_not_exist(page: WebPageSink, path: str):
    assert ask(page, path)[0].status == 404


@pytest.mark.parametrize(
    ("host", "status"), [("localhost:1", 200), ("127.0.0.1", 200), ("[::1]:8", 403), ("evil.example", 403), ("", 403)]
)
def test_a_page_of_this_machine_is_not_read_under_another_name(page: WebPageSink, host: str, status: int):
    """As a site would whose name is made to lead here."""
    assert ask(page, "/state.json", host=host or " ")[0].status == status


def test_the_page_asks_nobody_else_and_has_what_its_script_names():
    text = (Path(__file__).parents[3] / "sigmaslam/live/web_page.html").read_text(encoding="utf-8")
    assert "http:" not in text
    assert "https:" not in text
    names: set[str | None] = set()

    class Reader(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            names.add(dict(attrs).get("id"))

    Reader().feed(text)
    assert {"status", "image", "plan", "facts", "verdict"} <= names


@pytest.mark.skipif(not socket.has_ipv6, reason="no IPv6")
@pytest.mark.parametrize(
    ("address", "host", "guest"),
    [("[::1]:0", "[::1]", 403), ("::1:0", "[::1]", 403), ("[::]:0", "[::]", 200), (":::0", "[::]", 200)],
)
def test_a_page_is_at_an_address_of_version_6(camera: StereoCamera, address: str, host: str, guest: int):
    page = WebPageSink(address, camera, judge)
    try:
        assert page.url.startswith(f"http://{host}:")
        assert state_of(page) == {"frame": None}
        assert ask(page, "/state.json", host="localhost")[0].status == 200
        assert ask(page, "/state.json", host="evil.example")[0].status == guest
    finally:
        page.close()


@pytest.mark.parametrize(
    "address", ["", "here", "127.0.0.1:", "70000", "8000:here", "-1", "256.0.0.1:8000", "::", "::1"]
)
def test_what_is_no_address_is_refused(camera: StereoCamera, address: str):
    with pytest.raises(InputError, match="--serve"):
        WebPageSink(address, camera, judge)


def test_a_port_that_is_taken_is_named_before_anything_is_tracked(demo_sequence: Path, tmp_path: Path):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        done = run_here("track", demo_sequence, "--out", tmp_path / "run", "--serve", str(port))
    assert_refused(done, f"--serve {port}", "another HOST or PORT")
    assert not (tmp_path / "run").exists()


def test_a_client_that_says_nothing_or_goes_stops_nothing(page: WebPageSink, caplog: pytest.LogCaptureFixture):
    host, port = page.url.split("/")[2].split(":")
    with socket.create_connection((host, int(port))) as silent:
        silent.sendall(b"GET /sta")
        page.add(frame_at(0, np.eye(4)))
        assert state_of(page)["frame"] == 0
    assert not caplog.records


@pytest.mark.long
def test_a_run_that_is_watched_is_the_same_to_the_bit(demo_sequence: Path, tmp_path: Path):
    data = os.environ.get("SIGMASLAM_DATA")
    # Real frames where there are some.
    source = Path(data) / "kitti_raw_0926_0039_a" if data else demo_sequence
    sequence = open_sequence(source).select(Selection(0, FRAMES))
    page = WebPageSink("0", sequence.camera, judge)
    seen: list[int | None] = []
    shapes: set[tuple[int, ...]] = set()
    ended = threading.Event()

    def watch() -> None:
        while not ended.is_set():
            try:
                seen.append(state_of(page)["frame"])
                if seen[-1] is not None:
                    shapes.add(picture_of(page).shape)
            except (OSError, http.client.HTTPException):
                return

    watcher = threading.Thread(target=watch)
    watcher.start()
    track(sequence, tmp_path / "watched", "klt", live=LiveOptions(sinks=[page]))
    ended.set()
    watcher.join()
    track(sequence, tmp_path / "alone", "klt")
    numbers = [each for each in seen if each is not None]
    assert numbers == sorted(numbers)
    assert len(set(numbers)) > 2
    assert len(shapes) == 1
    for name in ("trajectory.tum", "covariance.npy", "trajectory_final.tum", "map.npz"):
        assert (tmp_path / "watched" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()
    with pytest.raises(OSError, match=r"refused|reset"):
        ask(page, "/")
