"""Recordings played at their time stamps: what is handed over when, what is dropped, and the latency that is told."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sigmaslam.readers import StereoFrame
from sigmaslam.run_record import real_time
from sigmaslam.run_record.frame_table import read_frames
from sigmaslam.run_record.real_time import POLICY, FrameTiming
from tests.support.commands import run_here
from tests.support.tracked import track

FRAMES = 40
# The clock of the demo, which takes two seconds, runs so many times as fast: nothing can keep up with it.
HASTE = 10.0
BLANK = np.zeros((2, 2), np.uint8)


class Clock:
    """In place of `time`: stands still but for what sleeps or works."""

    def __init__(self) -> None:
        self.now = 1234.5
        self.slept = 0.0

    def perf_counter(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0.0
        self.now += seconds
        self.slept += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    fake = Clock()
    monkeypatch.setattr(real_time, "time", fake)
    return fake


@pytest.fixture
def haste(monkeypatch: pytest.MonkeyPatch) -> None:
    """Recordings are played faster than any computer tracks them."""
    hasty = SimpleNamespace(
        perf_counter=lambda: HASTE * time.perf_counter(), sleep=lambda seconds: time.sleep(seconds / HASTE)
    )
    monkeypatch.setattr(real_time, "time", hasty)


def play(
    clock: Clock, timestamps: Iterable[float], work: Iterable[float], timing: FrameTiming | None = None
) -> tuple[list[int], list[float], int]:
    """Numbers of the frames that a consumer gets who works so long on each, seconds, when it gets them, and drops."""
    timing = timing or FrameTiming(is_played=True)
    frames = (StereoFrame(k, timestamp, BLANK, BLANK) for k, timestamp in enumerate(timestamps))
    durations, began = iter(work), clock.now
    given, times = [], []
    for frame in timing.play(frames):
        given.append(frame.index)
        times.append(clock.now - began)
        clock.now += next(durations)
        timing.note(frame.timestamp)
    return given, times, timing.dropped


# The player


def test_a_fast_consumer_gets_every_frame_at_its_time(clock: Clock):
    timestamps = 0.1 * np.arange(10)
    given, times, dropped = play(clock, 1.4e9 + timestamps, [0.03] * 10)
    assert given == list(range(10))
    np.testing.assert_allclose(times, timestamps, atol=1e-5)
    assert dropped == 0
    assert clock.slept == pytest.approx(0.9 - 9 * 0.03, abs=1e-5)


def test_a_slow_consumer_gets_the_newest_frame_that_has_come(clock: Clock):
    """Ready after 0.27, 0.54, 0.81 and 1.08 seconds."""
    given, times, dropped = play(clock, 0.1 * np.arange(10), [0.27] * 10)
    assert given == [0, 2, 5, 8, 9]
    np.testing.assert_allclose(times, [0.0, 0.27, 0.54, 0.81, 1.08])
    assert dropped == 5
    assert clock.slept == 0.0


def test_after_one_slow_frame_only_those_that_came_meanwhile_are_dropped(clock: Clock):
    given, times, dropped = play(clock, 0.1 * np.arange(10), [0.03, 0.03, 0.35, *[0.03] * 7])
    assert given == [0, 1, 2, 5, 6, 7, 8, 9]
    assert dropped == 2
    np.testing.assert_allclose(times, [0.0, 0.1, 0.2, 0.55, 0.6, 0.7, 0.8, 0.9])


def test_a_gap_of_the_recording_is_waited_for(clock: Clock):
    given, times, dropped = play(clock, [3.0, 3.1, 9.0], [0.25, 0.05, 0.05])
    assert given == [0, 1, 2]
    np.testing.assert_allclose(times, [0.0, 0.25, 6.0])
    assert dropped == 0


@pytest.mark.parametrize("count", [0, 1])
def test_hardly_any_frames_are_played_without_waiting(clock: Clock, count: int):
    assert play(clock, [7.0][:count], [0.1]) == ([0][:count], [0.0][:count], 0)
    assert clock.slept == 0.0


# Latency


def test_latency_counts_from_when_the_first_frame_was_handed_over(clock: Clock):
    timing = FrameTiming(is_played=True)
    timing.start(50.0)
    clock.now += 0.5
    timing.start(50.1)  # the first one alone is taken
    assert timing.age(50.0) == pytest.approx(0.5)
    assert timing.age(50.8) == pytest.approx(-0.3)


def test_percentiles_of_the_latency_are_in_milliseconds(clock: Clock):
    timing = FrameTiming(is_played=True)
    assert timing.latency_ms() == {}
    timing.start(0.0)
    for seconds in np.random.default_rng(0).permutation(np.arange(101)) / 1000.0:
        clock.now = 1234.5 + 9.0 + seconds
        timing.note(9.0)
    assert timing.latency_ms() == {"p50": 50.0, "p95": 95.0, "p99": 99.0, "max": 100.0}


def test_the_latency_of_a_slow_consumer_has_the_time_that_frames_waited(clock: Clock):
    """Of frames 0, 2, 5, 8 and 9: 0.27, 0.34, 0.31, 0.28 and 0.45 seconds."""
    timing = FrameTiming(is_played=True)
    _, _, dropped = play(clock, 0.1 * np.arange(10), [0.27] * 10, timing)
    described = timing.describe(dropped)["real_time"]
    assert described["policy"] == POLICY
    assert described["dropped"] == 5
    assert described["latency_ms"]["p50"] == pytest.approx(310.0, abs=0.1)
    assert described["latency_ms"]["max"] == pytest.approx(450.0, abs=0.1)


# Runs


@pytest.mark.long
@pytest.mark.usefixtures("haste")
def test_a_run_in_real_time_tells_what_was_dropped_and_the_latency(demo_sequence: Path, tmp_path: Path):
    summary = track(demo_sequence, tmp_path / "run", "klt", realtime=True, threads=1)
    run, frames = json.loads((tmp_path / "run/run.json").read_text()), read_frames(tmp_path / "run/frames.csv")
    timing = run["real_time"]
    assert summary["real_time"] == timing
    assert run["dropped"] == timing["dropped"] > 0
    assert timing["dropped"] + len(frames) == FRAMES
    assert summary["frames"] == len(frames)
    latency = timing["latency_ms"]
    assert list(latency) == ["p50", "p95", "p99", "max"]
    assert 0.0 < latency["p50"] <= latency["p95"] <= latency["p99"] <= latency["max"]
    assert (np.diff(frames.seconds) > 0).all()
    report = " ".join((tmp_path / "run/report.html").read_text(encoding="utf-8").split())
    assert f">{timing['dropped']}<" in report
    assert f"p50 {latency['p50']:.0f}, p95 {latency['p95']:.0f}, p99 {latency['p99']:.0f}" in report


@pytest.mark.long
@pytest.mark.usefixtures("without_report")
def test_a_recording_that_is_not_played_drops_nothing_and_tells_no_latency(demo_sequence: Path, tmp_path: Path):
    summary = track(demo_sequence, tmp_path / "run", "klt", threads=1)
    run = json.loads((tmp_path / "run/run.json").read_text())
    assert summary["frames"] == FRAMES
    assert run["dropped"] == 0
    assert "real_time" not in run
    assert "real_time" not in summary


@pytest.mark.long
@pytest.mark.usefixtures("clock", "without_report")
def test_a_frame_that_cannot_be_read_has_its_row_where_its_time_is(demo_sequence: Path, tmp_path: Path):
    """As it has in a run that is not in real time."""
    folder = tmp_path / "sequence"
    for eye in ("image_0", "image_1"):
        (folder / eye).mkdir(parents=True)
        for image in sorted((demo_sequence / eye).iterdir())[:4]:
            shutil.copy(image, folder / eye)
    shutil.copy(demo_sequence / "calib.txt", folder)
    times = (demo_sequence / "times.txt").read_text().splitlines()[:4]
    (folder / "times.txt").write_text("\n".join(times) + "\n")
    sorted((folder / "image_0").iterdir())[2].write_bytes(b"no image")
    for name, in_real_time in (("as fast as it goes", False), ("in real time", True)):
        track(folder, tmp_path / name, "klt", realtime=in_real_time, threads=1)
        frames = read_frames(tmp_path / name / "frames.csv")
        assert len(frames) == 4
        assert frames.status.index("skipped") == 2, name
        assert (np.diff(frames.seconds) > 0).all()


@pytest.mark.long
@pytest.mark.usefixtures("without_report")
def test_the_command_line_plays_in_real_time(demo_sequence: Path, tmp_path: Path):
    """Without haste: on a busy machine all frames but the first would be dropped, which is a failed run."""
    options = ["--out", tmp_path / "run", "--frontend", "klt", "--realtime", "--threads", "1"]
    result = run_here("track", demo_sequence, *options)
    assert result.returncode == 0, result.stderr
    timing = json.loads((tmp_path / "run/run.json").read_text())["real_time"]
    assert f"In real time: {timing['dropped']} frames dropped; latency in ms: p50 " in result.stdout


def test_the_command_line_offers_real_time_and_threads():
    result = run_here("track", "--help-all")
    assert result.returncode == 0
    assert "--realtime" in result.stdout
    assert "--threads" in result.stdout


def test_no_threads_are_refused(demo_sequence: Path, tmp_path: Path):
    result = run_here("track", demo_sequence, "--out", tmp_path / "run", "--threads", "0")
    assert result.returncode == 2
    assert "--threads" in result.stderr
    assert not (tmp_path / "run").exists()
