"""The benchmark of run time: its processes, and the page that it makes of them."""

import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

import sigmaslam
from sigmaslam.errors import InputError
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.readers import open_sequence
from sigmaslam_benchmarks.tracking import runtime
from sigmaslam_benchmarks.tracking.decoded_pairs import DecodedPairs, open_pairs, write_pairs
from sigmaslam_benchmarks.tracking.runtime import TimingChoice, time_everything, write_runtime
from sigmaslam_benchmarks.tracking.runtime_page import SEQUENCE, SIZE, TimedRun, format_runtime
from sigmaslam_benchmarks.tracking.sequences_page import Omission
from sigmaslam_benchmarks.tracking.stereo_peers import CuvslamPeer, MissingPeerError, OrbSlamPeer, orb_settings
from sigmaslam_benchmarks.tracking.time_method import METHODS, FailedMethodError, MethodTiming, TimingJob, time_method
from tests.support.commands import run_here

FRAMES = 6
CAMERA = RectifiedStereo(500.0, 500.0, 320.0, 240.0, 0.1, 640, 480)


@pytest.fixture(scope="module")
def pairs(demo_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> DecodedPairs:
    """The first frames of the demo."""
    sequence = open_sequence(demo_sequence)
    with closing(sequence.frames()) as frames:
        return write_pairs(tmp_path_factory.mktemp("pairs"), islice(frames, FRAMES), sequence.camera)


@pytest.fixture(autouse=True)
def compiled_folders(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Those that would be compiled to bytecode, which takes seconds."""
    folders: list[str] = []
    monkeypatch.setattr(runtime.compileall, "compile_dir", lambda folder, **_: folders.append(folder))
    return folders


def _timing(cpu_ms: float, version: str = "") -> MethodTiming:
    """Of four frames, the last of which takes twice as long, and is ours a keyframe, and 0.6 J."""
    time, keyframes = [cpu_ms, cpu_ms, cpu_ms, 2 * cpu_ms], [] if version else [False, False, False, True]
    return MethodTiming(time, time, 6, [], [], 0.5, 100.0, version, keyframes, 0.6)


def _run(method: str, threads: int, turn: int, timing: MethodTiming, section: str = SEQUENCE) -> TimedRun:
    return TimedRun(section, "demo", "320x240", method, threads, turn, timing, 0.0123)


def _rows(page: str, label: str) -> list[list[str]]:
    cells = ([cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines() if line.startswith("|"))
    return [row for row in cells if row[0] == label]


def test_pairs_read_back_as_they_were_written(pairs: DecodedPairs, demo_sequence: Path):
    opened = open_pairs(pairs.folder)
    assert opened.timestamps == pairs.timestamps
    assert opened.camera.left == pairs.camera.left
    assert opened.rectified == pairs.rectified
    with closing(open_sequence(demo_sequence).frames()) as frames:
        third = next(islice(frames, 2, None))
    for rectified in (False, True):  # the demo is rectified
        np.testing.assert_array_equal(np.stack(opened.read(2, rectified)), np.stack([third.left, third.right]))


def test_a_resized_camera_sees_the_same_rays(pairs: DecodedPairs, tmp_path: Path):
    half = pairs.resize(tmp_path, 0.5)
    assert half.size == "160x120"
    assert half.read(FRAMES - 1)[1].shape == (120, 160)
    # The corner of the image, half a pixel before the centre of its first one, stays.
    corner = np.array([[-0.5, -0.5]])
    np.testing.assert_allclose(half.rectified.rays(corner), pairs.rectified.rays(corner))
    assert half.rectified.focal_baseline == pytest.approx(0.5 * pairs.rectified.focal_baseline)


def test_methods_start_from_bytecode_as_where_they_are_installed(compiled_folders: list[str]):
    assert isinstance(next(time_everything(TimingChoice(None, ["ours"], ["kitti_raw_0926_0039_a"]))), Omission)
    assert compiled_folders == [str(Path(sigmaslam.__file__).parent)]


@pytest.mark.long
@pytest.mark.parametrize("method", ["klt-pnp", "klt"])
def test_a_process_of_its_own_tells_what_a_method_took(pairs: DecodedPairs, method: str):
    timing = time_method(TimingJob(str(pairs.folder), method))
    assert timing.frames == len(timing.poses) == len(timing.timestamps) == FRAMES
    assert len(timing.cpu_ms) == len(timing.wall_ms) == FRAMES - 2
    assert min(timing.cpu_ms) > 0.1
    # One core has no more CPU time than there is time.
    assert sum(timing.cpu_ms) < 1.05 * sum(timing.wall_ms) + 1.0
    assert 20 < timing.peak_mib < 2000
    assert 0.05 < timing.first_pose_s < 60
    np.testing.assert_allclose(timing.poses[0], np.eye(4), atol=1e-9)
    steps = np.linalg.norm(np.diff(np.array(timing.poses)[:, :3, 3], axis=0), axis=1)
    assert (steps > 0.001).all()


def test_a_process_that_fails_is_told_of_with_its_last_words(tmp_path: Path):
    with pytest.raises(FailedMethodError, match=r"code 1: FileNotFoundError.*pairs\.json"):
        time_method(TimingJob(str(tmp_path), "klt-pnp"))


@pytest.mark.parametrize(
    ("module", "make"), [("dim_odom", CuvslamPeer), ("pyorbslam3", lambda camera: OrbSlamPeer(camera, 20.0))]
)
def test_a_peer_that_is_not_installed_says_how_to_install_it(
    module: str, make: Callable[[RectifiedStereo], object], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingPeerError, match=rf"{module} is not installed: pip install 'sigmaslam\[peers\]'"):
        make(CAMERA)


def test_orb_slam_has_more_keypoints_on_wide_images():
    assert "nFeatures: 1200" in orb_settings(CAMERA, 20.0)
    settings = orb_settings(RectifiedStereo(700.0, 700.0, 600.0, 180.0, 0.5, 1242, 375), 10.0)
    assert "nFeatures: 2000" in settings
    assert "Camera.bf: 350.0" in settings


def test_a_peer_that_is_missing_is_left_out_with_a_note_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    asked = []

    def time_it(job: TimingJob) -> MethodTiming:
        asked.append(job.method)
        if job.method == "cuvslam":
            raise MissingPeerError("dim_odom is not installed")
        return _timing(10.0)

    monkeypatch.setattr(runtime, "time_method", time_it)
    notes: list[str] = []
    page = tmp_path / "runtime.md"
    page.write_text("old\n<!-- notes -->\nkept words\n")
    text = write_runtime(page, None, "the command", ("klt-pnp", "cuvslam"), ["demo"], 2, 5, note=notes.append)
    assert text == page.read_text()
    assert text.endswith("<!-- notes -->\nkept words\n")
    assert asked.count("cuvslam") == 1
    # Twice a round with one and two threads, and once with every size.
    assert asked.count("klt-pnp") == 2 * (2 + len(runtime.SCALES))
    assert text.count("cuVSLAM is left out: dim_odom is not installed") == 1
    assert sum("cuVSLAM is left out" in each for each in notes) == 1
    assert _rows(text, "cuVSLAM") == []
    (row, sizes) = _rows(text, "KLT + PnP")
    assert row[3] == "12.5 (12.5 - 12.5)"
    assert len(sizes) == 1 + len(runtime.SCALES)


def test_a_method_that_fails_is_left_out_where_it_fails(monkeypatch: pytest.MonkeyPatch):
    def fail(job: TimingJob) -> MethodTiming:
        raise FailedMethodError("its process ended with code -11")

    monkeypatch.setattr(runtime, "time_method", fail)
    results = list(time_everything(TimingChoice(None, ("klt-pnp",), ["demo"], 2, 5)))
    assert len(results) == 1 + len(runtime.SCALES)
    assert all(isinstance(result, Omission) and result.method == "klt-pnp" for result in results)
    assert "demo 320x240 (KLT + PnP) is left out: its process ended with code -11" in format_runtime(results, "", 2)


def test_what_was_measured_is_written_when_it_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def stop(job: TimingJob) -> MethodTiming:
        if job.threads == 2:
            raise KeyboardInterrupt
        return _timing(10.0)

    monkeypatch.setattr(runtime, "time_method", stop)
    page = tmp_path / "runtime.md"
    with pytest.raises(KeyboardInterrupt):
        write_runtime(page, None, "the command", ("klt-pnp",), ["demo"], 1, 5)
    assert "Stopped before the end" in page.read_text()
    ((_, _, _, cpu, _, ratio, wall, *_),) = _rows(page.read_text(), "KLT + PnP")
    assert (cpu, ratio, wall) == ("12.5", "-", "-")


def test_the_page_has_means_over_frames_medians_over_rounds_and_ratios_within_them():
    runs: list[TimedRun | Omission] = []
    for turn, slowness in enumerate((1.0, 2.0, 10.0)):  # the machine was busy
        for threads in (1, 2):
            runs.append(_run("ours", threads, turn, _timing(30.0 * slowness)))
            runs.append(_run("cuvslam", threads, turn, _timing(10.0 * slowness, version="dim-odom 1.0")))
    runs.append(_run("ours", 1, 0, _timing(30.0), SIZE))
    page = format_runtime(runs, "the command", 3)
    assert "`the command`" in page
    assert "3 rounds" in page
    assert "Peers: dim-odom 1.0." in page
    table, size = _rows(page, "ours")
    assert table[1:4] == ["0 of 6", "0.0123", "75.0 (37.5 - 375.0)"]
    assert table[4:7] == ["60.0, 111.0, 118.2", "3.00", "75.0 (37.5 - 375.0)"]
    assert table[8:] == ["13.3", "100", "0.50", "100"]  # 1 / (60 + 60 + 60 + 120) ms * 4
    assert size == ["ours", "37.5"]
    assert "| ours, keyframes | 1 | 120.0 | 120.0, 120.0, 120.0 |" in page
    assert "| ours, others | 3 | 60.0 | 60.0, 60.0, 60.0 |" in page
    assert "cuVSLAM, keyframes" not in page
    every = replace(_timing(30.0), keyframes=[True] * 4)
    assert "ours, others" not in format_runtime([_run("ours", 1, 0, every)], "", 1)
    assert _rows(page, "cuVSLAM")[0][5] == "1.00"


def test_sequences_that_are_not_there_are_left_out_with_a_note(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fail(*_: object) -> None:
        raise ImportError(name="torch")

    monkeypatch.setattr(runtime, "render", fail)
    text = write_runtime(tmp_path / "runtime.md", tmp_path, "the command", METHODS)
    assert "room is left out: torch is not installed" in text
    for name in runtime.REAL:
        assert f"{name} is left out: {tmp_path} does not hold it" in text


@pytest.mark.parametrize("names", [{"methods": ["magic"]}, {"sequences": ["magic"]}])
def test_an_unknown_name_is_refused_with_those_that_are_known(names: dict[str, list[str]]):
    with pytest.raises(InputError, match=r"'magic' is unknown; choose of (ours|kitti\w+), "):
        TimingChoice(None, **names)


def test_frames_that_are_all_warm_up_are_refused():
    with pytest.raises(InputError, match="--frames is 3: give at least 4"):
        TimingChoice(None, frames=3)


def test_the_command_line_offers_it():
    assert "runtime" in run_here("benchmark", "--help").stdout
