"""Streams of estimates: what a line says, and readers that are slow, gone, or not there."""

import json
import os
import socket
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.bodies.object_tracker import ObjectEstimate
from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import quaternion_to_matrix, se3_exp
from sigmaslam.live.estimate_stream import PipeStream, format_estimate, open_stream
from sigmaslam.live.frame_sink import TrackedFrame
from sigmaslam.readers import open_sequence
from sigmaslam.run_record.pose_file import COLUMNS
from sigmaslam.runs.request import LiveOptions
from tests.support.commands import command_line, environment, run_process
from tests.support.demo_parts import copy_frames
from tests.support.recorded_runs import some_estimate
from tests.support.tracked import track

FRAMES = 6


@pytest.fixture(scope="module")
def sequence(demo_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return copy_frames(demo_sequence, tmp_path_factory.mktemp("some") / "sequence", FRAMES)


def assert_equals_pose_table(lines: list[str], run: Path) -> None:
    """Every line is one row of poses.csv, to the last digit that stands there."""
    header, *rows = (line.split(",") for line in (run / "poses.csv").read_text().splitlines())
    assert tuple(header) == COLUMNS
    assert len(lines) == len(rows) == FRAMES
    for number, (line, row) in enumerate(zip(lines, rows, strict=True)):
        said = json.loads(line)
        assert said["frame"] == number
        upper = np.array(said["covariance"])[np.triu_indices(6)]
        numbers = *said["T_world_camera"]["position"], *said["T_world_camera"]["quaternion_xyzw"], *upper
        assert [f"{said['time']:.9f}", said["status"], *(f"{each:.9g}" for each in numbers)] == row


@pytest.mark.long
def test_lines_on_the_standard_output_are_the_rows_of_the_pose_table(sequence: Path, tmp_path: Path):
    done = run_process("track", sequence, "--out", tmp_path / "run", "--frontend", "klt", "--stream", "stdout")
    assert done.returncode == 0, done.stderr
    assert_equals_pose_table(done.stdout.splitlines(), tmp_path / "run")
    assert "frames tracked" in done.stderr


def test_datagrams_are_the_rows_of_the_pose_table(sequence: Path, tmp_path: Path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5.0)
        stream = open_stream(f"udp://127.0.0.1:{receiver.getsockname()[1]}")
        track(sequence, tmp_path / "run", "klt", live=LiveOptions(sinks=[stream]))
        assert_equals_pose_table([receiver.recv(65536).decode() for _ in range(FRAMES)], tmp_path / "run")


def test_datagrams_that_nobody_receives_do_not_matter(sequence: Path, tmp_path: Path):
    stream = open_stream("udp://127.0.0.1:9")
    summary = track(sequence, tmp_path / "run", "klt", live=LiveOptions(sinks=[stream]))
    assert summary["poses"] == FRAMES


@pytest.mark.long
def test_a_reader_that_has_gone_ends_a_whole_run_with_code_1(sequence: Path, tmp_path: Path):
    reader, writer = os.pipe()
    os.close(reader)
    arguments = ("--out", tmp_path / "run", "--frontend", "klt", "--stream", "stdout")
    done = subprocess.run(
        command_line("track", sequence, *arguments),
        env=environment(),
        stdout=writer,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        timeout=120,
    )
    os.close(writer)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert json.loads((tmp_path / "run" / "run.json").read_text())["summary"]["poses"] == FRAMES


def test_a_reader_that_never_reads_does_not_hold_the_tracker_up():
    reader, writer = os.pipe()
    stream = PipeStream(os.fdopen(writer, "wb", buffering=0))
    began, frame = time.monotonic(), TrackedFrame(0, some_estimate(0.0, "tracking", 1.0, 6), None)
    for _ in range(300):  # more than a pipe holds
        stream.add(frame)
    stream.close()
    stream.wait(0.1)
    assert time.monotonic() - began < 5.0
    assert not stream.is_broken
    # What it reads in the end is whole.
    with os.fdopen(reader, "rb") as late:
        assert [json.loads(late.readline())["frame"] for _ in range(300)] == [0] * 300
        stream.wait(None)


def test_before_there_is_a_pose_a_line_has_nulls():
    unknown = replace(
        some_estimate(1.5, "starting", 0.0, 0),
        T_world_camera=np.full((4, 4), np.nan),
        covariance=np.diag(np.full(6, np.inf)),
        belief=0.0,
    )
    said = json.loads(format_estimate(TrackedFrame(3, unknown, None)))
    assert said["T_world_camera"] is None
    assert said["covariance"] is None
    assert (said["time"], said["frame"], said["status"], said["belief"]) == (1.5, 3, "starting", 0.0)


def test_of_a_followed_body_the_line_has_its_pose_in_the_camera():
    pose = se3_exp(np.array([0.1, -0.2, 0.3, 0.4, -0.5, 0.6]))
    result = ObjectEstimate(replace(some_estimate(0.0, "tracking", 1.0, 6), T_world_camera=pose))
    said = json.loads(format_estimate(TrackedFrame(0, result, None)))
    assert "T_world_camera" not in said
    np.testing.assert_allclose(said["T_camera_object"]["position"], result.pose[:3, 3])
    rotation = quaternion_to_matrix(np.array(said["T_camera_object"]["quaternion_xyzw"]))
    np.testing.assert_allclose(rotation, result.pose[:3, :3], atol=1e-12)


def test_a_callback_gets_every_estimate_once_it_is_on_disk(sequence: Path, tmp_path: Path):
    rows, times = [], []

    def note(estimate):
        rows.append(len((tmp_path / "run" / "frames.csv").read_text().splitlines()) - 1)
        times.append(estimate.timestamp)

    track(sequence, tmp_path / "run", "klt", live=LiveOptions(on_estimate=note))
    assert rows == list(range(1, FRAMES + 1))
    assert times == [frame.timestamp for frame in open_sequence(sequence).frames()]


@pytest.mark.parametrize("target", ["", "file", "udp://127.0.0.1", "tcp://127.0.0.1:5", "udp://127.0.0.1:99999"])
def test_what_is_no_stream_is_refused(target: str):
    with pytest.raises(InputError, match=r"stdout, or udp://HOST:PORT"):
        open_stream(target)


@pytest.mark.parametrize("host", ["nowhere.invalid", ".."])
def test_a_host_that_is_not_there_is_named(host: str):
    with pytest.raises(InputError, match=f"{host}:5005.* name a host that there is"):
        open_stream(f"udp://{host}:5005")
