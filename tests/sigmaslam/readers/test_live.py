"""Live input: video files played as cameras, and cameras with faults."""

import json
import signal
import subprocess
import threading
import time
from collections import deque
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from sigmaslam.cli.commands import app
from sigmaslam.errors import CalibrationError, InputError
from sigmaslam.readers import StereoFrame, open_cameras
from sigmaslam.readers import live as camera_module
from sigmaslam.readers.capture import SYNCHRONY_PAIRS, StereoCapture, open_capture
from sigmaslam.readers.live import LivePairs, LiveSequence
from sigmaslam.readers.trajectory_files import read_tum
from sigmaslam.run_record.frame_table import read_frames
from tests.support.calibration_yaml import write_calibration
from tests.support.commands import command_line, environment, run_process
from tests.support.simulated_stereo import parallel_camera
from tests.support.stopped_runs import hear_signals
from tests.support.tracked import track
from tests.support.videos import write_video

WIDTH, HEIGHT = 64, 48
CAMERA = parallel_camera(WIDTH, HEIGHT, 50.0, 0.1)
PERIOD = 0.01
RATE_HZ = 50.0
FOREVER = 10**9


class FakeCamera:
    """Takes an image each period; its pixels are its number. As V4L2 does, it keeps the oldest ones until asked.

    Args:
        late: seconds by which it exposes after the common tick.
        buffers: images that can wait.
        driver: V4L2 tells when images were exposed.
        unplugged_after, frozen_after: number of grabs after which they fail, or block.
    """

    began = time.monotonic()

    def __init__(
        self, late=0.0, buffers=1, driver="FAKE", unplugged_after=FOREVER, frozen_after=FOREVER, period=PERIOD
    ):
        self.period = period
        self.late, self.buffers, self.driver = late, buffers, driver
        self.unplugged_after, self.frozen_after = unplugged_after, frozen_after
        self.waiting: deque[int] = deque()
        self.next = int((time.monotonic() - self.began) / period)
        self.number = -1
        self.grabs = 0
        self.released = threading.Event()

    def exposed(self, number: int) -> float:
        return self.began + number * self.period + self.late

    def grab(self) -> bool:
        self.grabs += 1
        if self.grabs > self.frozen_after:
            self.released.wait(2.0)
        if self.grabs > min(self.unplugged_after, self.frozen_after):
            return False
        while self.exposed(self.next) <= time.monotonic():
            if len(self.waiting) < self.buffers:
                self.waiting.append(self.next)
            self.next += 1
        if not self.waiting:
            time.sleep(max(0.0, self.exposed(self.next) - time.monotonic()))
            self.waiting.append(self.next)
            self.next += 1
        self.number = self.waiting.popleft()
        return True

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.full((HEIGHT, WIDTH, 3), self.number % 256, np.uint8)

    def get(self, prop: int, /) -> float:
        return {cv2.CAP_PROP_FPS: 1.0 / self.period, cv2.CAP_PROP_POS_MSEC: 1e3 * self.exposed(self.number)}[prop]

    def getBackendName(self) -> str:  # noqa: N802
        return self.driver

    def release(self) -> None:
        self.released.set()


def live(*cameras: FakeCamera, seconds: float | None = None) -> LiveSequence:
    names = [f"camera {index}" for index in range(len(cameras))]
    return LiveSequence(LivePairs(StereoCapture(cameras, names), "0,1", seconds), CAMERA, "0,1")


def number(frame: StereoFrame) -> int:
    return int(frame.left[0, 0])


@pytest.fixture(autouse=True)
def _settle_fast(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera_module, "SETTLE_S", 0.05)


# The latest pair wins


def test_a_slow_consumer_gets_the_latest_pair_and_the_rest_is_dropped(caplog):
    """Each pair is fresh though 9 of 10 are not looked at: nothing queues up."""
    left, right = FakeCamera(), FakeCamera()
    sequence = live(left, right)
    frames, ages = [], []
    for frame in sequence.frames():
        frames.append(frame)
        ages.append((left.number - number(frame)) % 256)
        if len(frames) == 6:
            break
        time.sleep(10 * PERIOD)
    assert np.median(ages) <= 2
    assert sequence.dropped >= 10
    assert sequence.dropped >= frames[-1].index - frames[0].index + 1 - len(frames)
    assert f"{sequence.dropped} of {sequence.dropped + 6} pairs were dropped: tracking takes longer" in caplog.text


def test_a_fast_consumer_gets_nearly_all():
    sequence = live(FakeCamera(), FakeCamera())
    frames = list(islice(sequence.frames(), 40))
    assert sequence.dropped < 20
    assert np.median(np.diff([frame.timestamp for frame in frames])) == pytest.approx(PERIOD, abs=5e-3)


def test_timestamps_begin_at_zero_and_increase():
    sequence = live(FakeCamera(), FakeCamera())
    times = [frame.timestamp for frame in islice(sequence.frames(), 20)]
    assert times[0] == 0.0
    assert np.all(np.diff(times) > 0)


def test_images_from_before_tracking_began_are_thrown_away():
    """While the tracker was made the buffers filled with images that are old now."""
    left, right = FakeCamera(buffers=4), FakeCamera(buffers=4)
    sequence = live(left, right)
    time.sleep(0.2)
    began = int((time.monotonic() - left.began) / PERIOD) % 256
    frame = next(sequence.frames())
    assert 0 <= (number(frame) - began) % 256 < 100


def test_seconds_end_the_sequence_and_give_the_cameras_back():
    cameras = FakeCamera(), FakeCamera()
    times = [frame.timestamp for frame in live(*cameras, seconds=0.2).frames()]
    assert 0.0 < times[-1] < 0.2
    assert all(camera.released.is_set() for camera in cameras)
    assert not [thread for thread in threading.enumerate() if thread.name == "sigmaslam-camera"]


def test_an_iteration_that_is_left_gives_the_cameras_back():
    cameras = FakeCamera(), FakeCamera()
    sequence = live(*cameras)
    frames = sequence.frames()
    next(frames)
    frames.close()
    assert all(camera.released.is_set() for camera in cameras)
    with pytest.raises(InputError, match="live images can be read once"):
        next(sequence.frames())


# Faults


@pytest.mark.parametrize("unplugged", [0, 1])
def test_an_unplugged_camera_ends_the_run_and_is_named(unplugged: int):
    cameras = FakeCamera(), FakeCamera()
    cameras[unplugged].unplugged_after = 30
    frames = []
    with pytest.raises(InputError, match=f"camera {unplugged} gives no more images: unplugged") as caught:  # noqa: PT012
        for frame in live(*cameras).frames():
            frames.append(frame)
    assert 1 <= len(frames) < 30
    assert caught.value.__cause__ is None


def test_a_grab_that_fails_now_and_then_ends_nothing(monkeypatch: pytest.MonkeyPatch):
    left = FakeCamera()
    grab = left.grab
    monkeypatch.setattr(left, "grab", lambda: grab() and left.grabs % 5 != 0)
    assert len(list(live(left, FakeCamera(), seconds=0.3).frames())) > 5


def test_a_camera_that_hangs_ends_the_run(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(camera_module, "STALL_S", 0.3)
    monkeypatch.setattr(camera_module, "_JOIN_S", 0.1)
    right = FakeCamera(frozen_after=20)
    with pytest.raises(InputError, match=r"for 0.3 s camera 0,1 gave no more images"):
        list(live(FakeCamera(), right).frames())
    right.release()


def test_a_camera_that_gives_nothing_is_refused_when_it_is_opened():
    with pytest.raises(InputError, match="camera 1 gives no images; is another program using it"):
        live(FakeCamera(), FakeCamera(unplugged_after=0))


# Left and right together


def median_difference(frames: list[StereoFrame]) -> float:
    return float(np.median([int(frame.left[0, 0]) - int(frame.right[0, 0]) for frame in frames]))


@pytest.mark.parametrize(("late", "warned"), [(0.007, True), (0.001, False)])
def test_eyes_that_are_not_taken_together_are_warned_about(caplog, late: float, warned: bool):
    left, right = FakeCamera(driver="V4L2", period=0.016), FakeCamera(driver="V4L2", period=0.016, late=late)
    list(islice(live(left, right).frames(), SYNCHRONY_PAIRS + 10))
    assert ("camera 0 and camera 1: left and right are taken 7 ms apart" in caplog.text) == warned


def test_grabbing_that_takes_long_is_warned_about(caplog, monkeypatch: pytest.MonkeyPatch):
    """A driver that tells no times: the right image is taken when its grab returns."""
    right = FakeCamera()
    monkeypatch.setattr(right, "grab", lambda: time.sleep(0.008) is None)
    capture = StereoCapture([FakeCamera(), right], ["camera 0", "camera 1"])
    for index in range(SYNCHRONY_PAIRS):
        capture.take(index)
    assert "camera 0 and camera 1: left and right are taken" in caplog.text


def test_a_buffer_of_old_images_in_one_eye_is_caught_up_with():
    """Grabbed in step, the right eye would stay three images behind for ever; the driver's clock shows it."""
    behind = {}
    for driver in ("FAKE", "V4L2"):
        sequence = live(FakeCamera(driver=driver), FakeCamera(driver=driver, buffers=4))
        time.sleep(10 * PERIOD)
        behind[driver] = median_difference(list(islice(sequence.frames(), 15)))
    assert behind["FAKE"] > 0
    assert behind["V4L2"] == 0


def test_the_drivers_clock_gives_the_time_of_exposure():
    """Images that come in bursts, as from a busy machine, keep their true distance in time."""
    left, right = FakeCamera(driver="V4L2", buffers=4), FakeCamera(driver="V4L2", buffers=4)
    capture = StereoCapture([left, right], ["camera 0", "camera 1"])
    capture.take(0)
    time.sleep(5 * PERIOD)
    times = [pair.timestamp for pair in (capture.take(index) for index in range(4)) if pair is not None]
    np.testing.assert_allclose(np.diff(times), PERIOD, atol=1e-9)


# Devices


def shade(index: int, eye: int, width: int = WIDTH) -> np.ndarray:
    return np.full((HEIGHT, width), 50 + 5 * index + 3 * eye, np.uint8)


@pytest.fixture
def videos(tmp_path: Path) -> Path:
    """left.avi, right.avi, both.avi and stereo.yaml."""
    for eye, name in enumerate(("left", "right")):
        write_video(tmp_path / f"{name}.avi", [shade(index, eye) for index in range(20)], RATE_HZ)
    write_video(tmp_path / "both.avi", [np.hstack([shade(index, 0), shade(index, 1)]) for index in range(20)], RATE_HZ)
    write_calibration(CAMERA, tmp_path / "stereo.yaml")
    return tmp_path


@pytest.mark.parametrize("device", ["{0}/left.avi,{0}/right.avi", "side-by-side:{0}/both.avi"])
def test_a_video_file_is_played_at_its_own_rate_as_a_camera(videos: Path, device: str):
    sequence = open_cameras(device.format(videos), videos / "stereo.yaml")
    assert (sequence.format, sequence.length, sequence.timestamps) == ("camera", None, None)
    assert sequence.source == device.format(videos)
    frames = list(sequence.frames())
    assert len(frames) + sequence.dropped == 19
    assert frames[-1].timestamp > 0.3
    for frame in frames:
        np.testing.assert_allclose(frame.left, shade(frame.index + 1, 0), atol=3)
        np.testing.assert_allclose(frame.right, shade(frame.index + 1, 1), atol=3)


@pytest.mark.parametrize("device", ["0", "0,0", "0,1,2", "0,", ",", "side-by-side:", ""])
def test_devices_that_are_no_stereo_pair_are_refused(videos: Path, device: str):
    with pytest.raises(InputError, match=r"give two different ones as LEFT,RIGHT \(0,1\), or side-by-side:0"):
        open_cameras(device, videos / "stereo.yaml")


@pytest.mark.parametrize("device", ["97", "/dev/video97", "/nowhere/left.mp4"])
def test_a_camera_that_cannot_be_opened_is_named(device: str):
    with pytest.raises(InputError, match=rf"camera {device} cannot be opened: is it plugged in, .* /dev/video\*"):
        open_capture(device)


def test_sizes_that_do_not_fit_are_refused(videos: Path):
    write_calibration(parallel_camera(128, 96, 50.0, 0.1), videos / "large.yaml")
    with pytest.raises(CalibrationError, match=r"left image is 64x48, the calibration is for 128x96"):
        open_cameras(f"side-by-side:{videos}/both.avi", videos / "large.yaml")
    wide = write_video(videos / "wide.avi", [shade(index, 1, 80) for index in range(3)], RATE_HZ)
    with pytest.raises(
        CalibrationError, match=r"different sizes: camera .*left.avi is 64x48, camera .*wide.avi is 80x48"
    ):
        open_cameras(f"{videos}/left.avi,{wide}", videos / "stereo.yaml")
    with pytest.raises(CalibrationError, match="cannot read the calibration"):
        open_cameras("0,1", videos / "nothing.yaml")


def test_one_image_for_both_eyes_needs_an_even_width(monkeypatch: pytest.MonkeyPatch):
    camera = FakeCamera()
    monkeypatch.setattr(camera, "retrieve", lambda: (True, np.zeros((HEIGHT, 2 * WIDTH + 1), np.uint8)))
    with pytest.raises(InputError, match=r"camera 0: 129 px wide; .* the width must be even"):
        live(camera)


# The command


@pytest.fixture(scope="module")
def demo_video(demo_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo side by side, twice there and back, at 10 Hz."""
    pairs = zip(*(sorted((demo_sequence / name).iterdir()) for name in ("image_0", "image_1")), strict=True)
    images = [np.hstack([cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in pair]) for pair in pairs]
    return write_video(tmp_path_factory.mktemp("demo") / "both.avi", 2 * (images + images[::-1]), 10.0)


@pytest.mark.long
def test_track_writes_what_a_camera_saw(demo_video: Path, demo_sequence: Path, tmp_path: Path):
    out = tmp_path / "run"
    calibration = demo_sequence / "calib.txt"
    result = run_process(
        "track",
        "--camera",
        f"side-by-side:{demo_video}",
        "--calibration",
        calibration,
        "--out",
        out,
        "--seconds",
        "1.5",
    )
    assert result.returncode == 0, result.stderr
    trajectory = read_tum(out / "trajectory.tum")
    assert len(trajectory) >= 2
    assert 0.0 == trajectory.timestamps[0] < trajectory.timestamps[-1] < 1.5
    run = json.loads((out / "run.json").read_text())
    assert (run["ended"], run["format"], run["input"]) == ("complete", "camera", f"side-by-side:{demo_video}")
    assert run["dropped"] + run["summary"]["frames"] > 10


@pytest.mark.usefixtures("without_report")
def test_an_unplugged_camera_leaves_what_was_tracked(tmp_path: Path):
    out = tmp_path / "run"
    with pytest.raises(InputError, match="camera 1 gives no more images"):
        track(live(FakeCamera(), FakeCamera(unplugged_after=60)), out, "klt")
    run = json.loads((out / "run.json").read_text())
    assert run["ended"].startswith("failed: camera 1 gives no more images: unplugged?")
    # Grey images have no points, so no frame has a pose.
    assert len(read_frames(out / "frames.csv")) == run["summary"]["starting"] >= 1
    assert not (out / "trajectory.tum").exists()


@pytest.mark.long
def test_ctrl_c_leaves_a_usable_run(demo_video: Path, demo_sequence: Path, tmp_path: Path):
    out = tmp_path / "run"
    options = ["--camera", f"side-by-side:{demo_video}", "--calibration", str(demo_sequence / "calib.txt")]
    command = command_line("track", *options, "--out", out)
    process = subprocess.Popen(
        command,
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        preexec_fn=hear_signals,
    )
    table = out / "frames.csv"
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not (table.exists() and len(table.read_text().splitlines()) > 3):
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    said, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Stopped; what was tracked until then is in" in said
    assert json.loads((out / "run.json").read_text())["ended"] == "interrupted"
    assert len(read_tum(out / "trajectory.tum")) >= 3


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "give either INPUT, a recording, or --camera, live cameras"),
        (["folder", "--camera", "0,1"], "not both"),
        (["--camera", "0,1"], "--camera needs --calibration"),
        (["folder", "--seconds", "3"], "--seconds goes with --camera"),
        (["--camera", "0,1", "--calibration", "c.yaml", "--format", "kitti"], "go with INPUT"),
        (["--camera", "0,1", "--calibration", "c.yaml", "--topic-left", "/left"], "go with INPUT"),
    ],
)
def test_options_that_do_not_go_together_are_refused(arguments: list[str], words: str, tmp_path: Path):
    result = CliRunner().invoke(app, ["track", *arguments, "--out", str(tmp_path / "run")])
    assert isinstance(result.exception, InputError)
    assert words in str(result.exception)
