import logging
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from sigmaslam.errors import CalibrationError, InputError
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.readers import StereoFrame, open_sequence
from sigmaslam.readers.pairing import list_images
from sigmaslam.readers.stereo_sequence import READ_AHEAD, read_ahead
from tests.support.calibration_yaml import write_calibration
from tests.support.videos import write_video

WIDTH, HEIGHT = 64, 48


def picture(index, eye=0, channels=1, dtype=np.uint8):
    rng = np.random.default_rng([index, eye])
    shape = (HEIGHT, WIDTH) if channels == 1 else (HEIGHT, WIDTH, channels)
    return rng.integers(0, 200, shape).astype(dtype)


def stereo_camera(width=WIDTH, height=HEIGHT):
    eye = CameraModel(width, height, 50.0, 50.0, width / 2, height / 2)
    T = np.eye(4)
    T[0, 3] = 0.1
    return StereoCamera(eye, eye, T)


def make_folder(root, count=6, left="left", right="right", name="{:06d}.png", calibration=True, **options):
    """A plain stereo folder; with other sub-folder names the images of another format."""
    for eye, folder in enumerate((left, right)):
        (root / folder).mkdir(parents=True)
        for index in range(count):
            assert cv2.imwrite(str(root / folder / name.format(index)), picture(index, eye, **options))
    if calibration:
        write_calibration(stereo_camera(), root / "calibration.yaml")
    return root


def kitti_line(t):
    return f"50 0 32 {t} 0 50 24 0 0 0 1 0"


def make_kitti(root, count=6, left="image_0", right="image_1", **options):
    make_folder(root, count, left, right, calibration=False, **options)
    (root / "calib.txt").write_text(f"P0: {kitti_line(0)}\nP1: {kitti_line(-5)}\n")
    (root / "times.txt").write_text("".join(f"{0.1 * index}\n" for index in range(count)))
    return root


def sensor(x, **changes):
    T = np.eye(4)
    T[0, 3] = x
    return {
        "T_BS": {"cols": 4, "rows": 4, "data": T.ravel().tolist()},
        "resolution": [WIDTH, HEIGHT],
        "camera_model": "pinhole",
        "intrinsics": [50.0, 50.0, 32.0, 24.0],
        "distortion_model": "radial-tangential",
        "distortion_coefficients": [-0.1, 0.01, 0.0, 0.0],
    } | changes


def write_sensor(path, x, **changes):
    path.write_text("%YAML:1.0\n" + yaml.safe_dump(sensor(x, **changes)))


STAMP = 1403715273262142976


def make_euroc(root, stamps_left, stamps_right, prefix="mav0"):
    for eye, stamps in enumerate((stamps_left, stamps_right)):
        camera = root / prefix / f"cam{eye}"
        (camera / "data").mkdir(parents=True)
        write_sensor(camera / "sensor.yaml", 0.1 * eye)
        for index, stamp in enumerate(stamps):
            cv2.imwrite(str(camera / "data" / f"{stamp}.png"), picture(index, eye))
    return root


def read_all(path, **options):
    sequence = open_sequence(path, **options)
    return sequence, list(sequence.frames())


def messages(caplog):
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


def reader_threads():
    return [thread for thread in threading.enumerate() if thread.name == "sigmaslam-read-ahead"]


# Real data


def test_kitti_odometry_folder(real_data: Path):
    sequence = open_sequence(real_data / "kitti_odometry_01_f000_050")
    assert (sequence.format, sequence.length, sequence.skipped) == ("kitti", 51, [])
    assert sequence.camera.is_rectified
    assert sequence.camera.left == CameraModel(1241, 376, 718.856, 718.856, 607.1928, 185.2157)
    assert sequence.camera.baseline == pytest.approx(0.53717, abs=1e-5)
    np.testing.assert_allclose(np.diff(sequence.timestamps), 0.1)
    frame = next(sequence.frames())
    assert frame.left.shape == frame.right.shape == (376, 1241)
    assert frame.left.dtype == np.uint8


def test_kitti_raw_folder_keeps_its_gap(real_data: Path):
    folder = real_data / "kitti_raw_0926_0039_a"
    sequence = open_sequence(folder)
    assert sequence.length == 186
    steps = np.diff(sequence.timestamps)
    assert np.flatnonzero(steps > 0.2).tolist() == [19]
    assert steps[19] == pytest.approx(0.31, abs=0.02)
    camera = open_sequence(folder, calibration=folder / "calib_cam_to_cam.txt").camera
    assert (camera.left, camera.right) == (sequence.camera.left, sequence.camera.right)
    assert sequence.camera.baseline == pytest.approx(0.53715, abs=1e-5)


def test_kitti_unrectified_folder_takes_the_original_intrinsics(real_data: Path, caplog):
    folder = real_data / "kitti_raw_0926_0039_a"
    sequence = open_sequence(folder / "raw_unrectified", calibration=folder / "calib_cam_to_cam.txt")
    assert (sequence.camera.left.distortion_model, sequence.camera.left.width) == ("radtan", 1392)
    assert sequence.camera.baseline == pytest.approx(0.5372, abs=1e-3)
    assert len(list(sequence.frames())) == 3
    assert "10 Hz" in messages(caplog)[0]


def test_euroc_asl_folder(real_data: Path):
    sequence, frames = read_all(real_data / "euroc_v1_01_static")
    assert (sequence.format, len(frames), sequence.skipped) == ("euroc", 12, [])
    assert sequence.camera.baseline == pytest.approx(0.11008, abs=1e-5)
    assert sequence.camera.left.distortion == (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
    assert [frame.timestamp for frame in frames] == sequence.timestamps
    assert sequence.timestamps[0] == 1403715273.262142976
    np.testing.assert_allclose(np.diff(sequence.timestamps), 0.05, atol=1e-6)


def test_euroc_flat_folder(real_data: Path):
    sequence = open_sequence(real_data / "euroc_v1_01_keyframes_a")
    assert (sequence.format, sequence.length) == ("euroc", 60)
    assert sequence.camera.baseline == pytest.approx(0.11008, abs=1e-5)
    frame = next(sequence.frames())
    assert frame.left.shape == (480, 752)
    assert not np.array_equal(frame.left, frame.right)


# Frames and threads


def test_frames_are_the_files_in_order_and_repeatable(tmp_path):
    sequence, frames = read_all(make_folder(tmp_path, 12, name="frame{}.png"))
    assert sequence.format == "folder"
    assert [frame.index for frame in frames] == list(range(12))
    for frame in frames:
        np.testing.assert_array_equal(frame.left, picture(frame.index, 0))
        np.testing.assert_array_equal(frame.right, picture(frame.index, 1))
    assert len(list(sequence.frames())) == 12
    assert not reader_threads()


def test_early_stop_ends_the_thread(tmp_path):
    frames = open_sequence(make_folder(tmp_path, 30)).frames()
    next(frames)
    assert len(reader_threads()) == 1
    frames.close()
    assert not reader_threads()
    for frame in open_sequence(tmp_path).frames():
        if frame.index == 3:
            break
    assert not reader_threads()


def test_read_ahead_is_bounded_and_passes_exceptions_on():
    produced = []

    def numbers():
        for number in range(100):
            if number == 20:
                raise RuntimeError("at 20")
            produced.append(number)
            yield number

    items = read_ahead(numbers, READ_AHEAD)
    assert next(items) == 0
    threading.Event().wait(0.2)
    assert len(produced) <= READ_AHEAD + 2
    received = []
    with pytest.raises(RuntimeError, match="at 20"):
        received.extend(items)
    assert produced == list(range(20))
    assert not reader_threads()


def test_consumer_errors_end_the_thread(tmp_path):
    sequence = open_sequence(make_folder(tmp_path, 30))

    def consume():
        for _ in sequence.frames():
            raise KeyError("consumer")

    with pytest.raises(KeyError):
        consume()
    assert not reader_threads()


# Broken images


def zero_bytes(path):
    path.write_bytes(b"")


def truncate(path):
    path.write_bytes(path.read_bytes()[:-200])


def resize(path):
    cv2.imwrite(str(path), np.zeros((20, 30), np.uint8))


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (zero_bytes, "file is empty"),
        (truncate, "not an image, or truncated"),
        (lambda path: path.write_text("hello"), "not an image"),
        (resize, "image is 30x20, the calibration is for 64x48"),
    ],
)
@pytest.mark.parametrize("eye", ["left", "right"])
def test_broken_image_is_skipped_and_named(tmp_path, caplog, fault, reason, eye):
    broken = make_folder(tmp_path, 6) / eye / "000003.png"
    fault(broken)
    sequence, frames = read_all(tmp_path)
    assert [frame.index for frame in frames] == [0, 1, 2, 4, 5]
    (skipped,) = sequence.skipped
    assert (skipped.index, skipped.timestamp) == (3, sequence.timestamps[3])
    assert str(broken) in skipped.reason
    assert reason in skipped.reason
    assert sum(str(broken) in message for message in messages(caplog)) == 1
    list(sequence.frames())
    assert len(sequence.skipped) == 1


def test_image_that_vanishes_after_opening_is_skipped(tmp_path):
    sequence = open_sequence(make_folder(tmp_path))
    (tmp_path / "right" / "000002.png").unlink()
    assert [frame.index for frame in sequence.frames()] == [0, 1, 3, 4, 5]
    assert "no such file" in sequence.skipped[0].reason


def test_truncated_jpeg_is_skipped(tmp_path):
    make_folder(tmp_path, 4, name="{:04d}.jpg")
    truncate(tmp_path / "left" / "0001.jpg")
    sequence, frames = read_all(tmp_path)
    assert len(frames) == 3
    assert "truncated" in sequence.skipped[0].reason


def test_broken_first_image_does_not_stop_opening(tmp_path):
    zero_bytes(make_folder(tmp_path) / "left" / "000000.png")
    sequence, frames = read_all(tmp_path)
    assert frames[0].index == 1
    assert sequence.skipped[0].index == 0


def test_too_many_failures_in_a_row_are_an_error(tmp_path):
    make_folder(tmp_path, 30)
    for index in range(5, 25):
        zero_bytes(tmp_path / "left" / f"{index:06d}.png")
    assert len(read_all(tmp_path)[1]) == 10
    zero_bytes(tmp_path / "left" / "000025.png")
    sequence = open_sequence(tmp_path)
    with pytest.raises(InputError, match=r"21 pairs in a row cannot be read.*000025.png: file is empty"):
        list(sequence.frames())
    assert not reader_threads()


def test_no_readable_image_is_an_error_at_open(tmp_path):
    make_folder(tmp_path, 3)
    for path in (tmp_path / "right").iterdir():
        zero_bytes(path)
    with pytest.raises(InputError, match=r"none of the first 3 pairs can be read.*right/000000.png: file is empty"):
        open_sequence(tmp_path)


@pytest.mark.parametrize("channels", [3, 4])
def test_colour_is_converted_and_warned_once(tmp_path, caplog, channels):
    _, frames = read_all(make_folder(tmp_path, channels=channels))
    expected = cv2.cvtColor(picture(2, 0, channels)[..., :3].copy(), cv2.COLOR_BGR2GRAY)
    np.testing.assert_array_equal(frames[2].left, expected)
    np.testing.assert_array_equal(frames[2].colour, picture(2, 0, channels)[..., :3])
    assert sum("colour image" in message for message in messages(caplog)) == 1


def test_images_of_a_type_that_is_not_read_are_named(tmp_path, caplog):
    for name in ("0.png", "1.WEBP", "2.gif", ".3.gif", "notes.txt"):
        (tmp_path / name).touch()
    assert [path.name for path in list_images(tmp_path)] == ["0.png"]
    assert "2 images are of a type that is not read (first: 1.WEBP)" in caplog.text


def test_16_bit_is_scaled_by_one_factor(tmp_path, caplog):
    make_folder(tmp_path, 3)
    pictures = [picture(index).astype(np.uint16) * factor for index, factor in enumerate((16, 4, 40))]
    pictures[0][0, 0] = 4095
    for index, image in enumerate(pictures):
        for eye in ("left", "right"):
            cv2.imwrite(str(tmp_path / eye / f"{index:06d}.png"), image)
    sequence, frames = read_all(tmp_path)
    for frame, image in zip(frames, pictures, strict=True):
        expected = np.minimum(np.rint(image * (255 / 4095)), 255)
        np.testing.assert_allclose(frame.left, expected, atol=1)
    assert sum("16-bit image, 12 significant bits" in message for message in messages(caplog)) == 1
    np.testing.assert_array_equal(next(sequence.frames()).left, frames[0].left)


def test_float_images_are_refused(tmp_path):
    make_folder(tmp_path, 2, name="{}.tif", dtype=np.float32)
    with pytest.raises(InputError, match="pixel type float32 is neither 8- nor 16-bit"):
        open_sequence(tmp_path)


# Folders that do not fit


def test_missing_folder_and_unknown_format(tmp_path):
    with pytest.raises(InputError, match="no such file or folder"):
        open_sequence(tmp_path / "nothing")
    with pytest.raises(
        InputError, match="'ros' is unknown; use one of auto, kitti, euroc, 4seasons, folder, video, bag"
    ):
        open_sequence(tmp_path, format="ros")


def test_auto_lists_what_it_looked_for(tmp_path):
    (tmp_path / "pictures").mkdir()
    with pytest.raises(InputError, match="no stereo sequence") as caught:
        open_sequence(tmp_path)
    for text in (
        "kitti: folders image_0 + image_1",
        "euroc: (also TUM-VI) folders cam0/data",
        "4seasons: folders undistorted_images",
        "folder: folders left",
        "video: one",
        "bag: a ROS bag",
    ):
        assert text in str(caught.value)


@pytest.mark.parametrize("format", ["kitti", "euroc", "folder", "video"])
def test_named_format_says_what_it_looked_for(tmp_path, format):
    with pytest.raises(InputError, match="looked for"):
        open_sequence(tmp_path, format=format)
    (tmp_path / "note.txt").write_text("hello")
    with pytest.raises(InputError, match=r"note.txt"):
        open_sequence(tmp_path / "note.txt", format=format)


@pytest.mark.parametrize("make", [make_folder, make_kitti])
def test_unequal_counts_name_counts_and_files(tmp_path, make):
    make(tmp_path)
    right = "right" if make is make_folder else "image_1"
    (tmp_path / right / "000002.png").unlink()
    with pytest.raises(InputError, match=rf"unequal left and right images: 6 in .*, 5 in .*{right}.*000002.png"):
        open_sequence(tmp_path)


def test_equal_counts_with_different_frames_are_refused(tmp_path):
    make_kitti(tmp_path)
    (tmp_path / "image_0" / "000001.png").unlink()
    (tmp_path / "image_1" / "000004.png").unlink()
    with pytest.raises(InputError, match=r"1 in image_0 .*000004.png.*1 in image_1 .*000001.png"):
        open_sequence(tmp_path)


@pytest.mark.parametrize("make", [make_folder, make_kitti])
def test_pairs_of_which_one_image_is_missing_are_left_out_with_a_warning(tmp_path, caplog, make):
    """The others keep their times, from a line for each frame, a line for each pair, or none at all."""
    make(tmp_path, count=22)
    left, right = ("left", "right") if make is make_folder else ("image_0", "image_1")
    (tmp_path / right / "000003.png").unlink()
    (tmp_path / left / "000009.png").unlink()
    kept = np.delete(np.arange(22), [3, 9])
    times = tmp_path / "times.txt"
    for lines in (0.1 * np.arange(22), 0.1 * kept, None):
        times.unlink(missing_ok=True)
        if lines is not None:
            np.savetxt(times, lines)
        caplog.clear()
        sequence = open_sequence(tmp_path)
        np.testing.assert_allclose(sequence.timestamps, 0.1 * kept)
        assert "2 frames are left out: 1 in" in caplog.text
        assert "000003.png" in caplog.text
    np.testing.assert_array_equal(list(open_sequence(tmp_path).frames())[3].right, picture(4, 1))


def test_frames_numbered_from_0_and_from_1_are_refused(tmp_path):
    make_folder(tmp_path, count=22)
    for path in sorted((tmp_path / "right").iterdir(), reverse=True):
        path.rename(path.with_name(f"{int(path.stem) + 1:06d}.png"))
    with pytest.raises(InputError, match=r"1 in left without partner \(first: 000000.png\); 1 in right .*000022.png"):
        open_sequence(tmp_path)


def test_empty_image_folder(tmp_path):
    (tmp_path / "left").mkdir()
    (tmp_path / "right").mkdir()
    with pytest.raises(InputError, match="left: no image files"):
        open_sequence(tmp_path)


def test_calibration_of_another_size_names_both(tmp_path):
    make_folder(tmp_path)
    other = tmp_path / "other.yaml"
    write_calibration(stereo_camera(128, 96), other)
    with pytest.raises(CalibrationError, match="left image is 64x48, the calibration is for 128x96"):
        open_sequence(tmp_path, calibration=other)


def test_folder_without_calibration(tmp_path):
    make_folder(tmp_path, calibration=False)
    with pytest.raises(CalibrationError, match=r"calibration.yaml: no calibration; .* --calibration"):
        open_sequence(tmp_path)


def test_calibration_of_any_form_overrides(tmp_path):
    make_folder(tmp_path / "plain", calibration=False)
    make_kitti(tmp_path / "kitti")
    sequence = open_sequence(tmp_path / "plain", calibration=tmp_path / "kitti" / "calib.txt")
    assert sequence.camera.baseline == pytest.approx(0.1)
    yaml_file = tmp_path / "own.yaml"
    T = np.eye(4)
    T[0, 3] = 0.7
    write_calibration(StereoCamera(stereo_camera().left, stereo_camera().right, T), yaml_file)
    assert open_sequence(tmp_path / "kitti", calibration=yaml_file).camera.baseline == pytest.approx(0.7)


def test_folder_times(tmp_path, caplog):
    make_folder(tmp_path, 3)
    assert open_sequence(tmp_path).timestamps == [0.0, 0.1, 0.2]
    assert "10 Hz" in messages(caplog)[0]
    (tmp_path / "times.txt").write_text("# seconds\n1.5\n1.75\n2.5\n")
    assert open_sequence(tmp_path).timestamps == [1.5, 1.75, 2.5]
    for text, message in (
        ("1\n2\n", "2 timestamps for 3 image pairs"),
        ("1\ntwo\n3\n", "line 2 is not a time in seconds: 'two'"),
        ("1\n3\n3\n", "times.txt: line 3 is 3.0, the time before is 3.0: times must increase"),
        ("nan\n3\n4\n", "times.txt: line 1 is nan: give a finite time"),
        ("0\n50\n100\n", r"times.txt: times such as 0, 50 apart, look like milliseconds: .* divided by 1e\+03"),
    ):
        (tmp_path / "times.txt").write_text(text)
        with pytest.raises(InputError, match=message):
            open_sequence(tmp_path)


def test_folder_names_that_are_stamps_give_the_times(tmp_path):
    names = [STAMP, STAMP + 50_000_000]
    make_folder(tmp_path, 0)
    for index, stamp in enumerate(names):
        cv2.imwrite(str(tmp_path / "left" / f"{stamp}.png"), picture(index))
        cv2.imwrite(str(tmp_path / "right" / f"{stamp + 1000}.png"), picture(index, 1))
    sequence, frames = read_all(tmp_path)
    assert sequence.timestamps == [stamp / 10**9 for stamp in names]
    np.testing.assert_array_equal(frames[1].right, picture(1, 1))


@pytest.mark.parametrize(
    ("name", "step", "first"),
    [
        ("{:.6f}", 0.05, 1403636584.763556),
        ("{:.0f}", 50, 1403636584763),
        ("{:.0f}", 50_000, 1403636584763555),
        ("{:.0f}", 50_000_000, 1403636584763555),
    ],
)
def test_names_in_any_unit_since_1970_give_the_times(tmp_path, name, step, first):
    """Sixteen digits with steps of 50 million are nanoseconds of a clock that started 16 days ago."""
    make_folder(tmp_path, 0)
    for index in range(3):
        for eye, side in enumerate(("left", "right")):
            cv2.imwrite(str(tmp_path / side / f"{name.format(first + index * step)}.png"), picture(index, eye))
    times = open_sequence(tmp_path).timestamps
    np.testing.assert_allclose(np.diff(times), 0.05, rtol=1e-5)
    assert times[0] == first / (20 * step)


def test_thirteen_digits_with_steps_of_no_clock_since_1970_are_frame_numbers(tmp_path, caplog):
    make_folder(tmp_path, 3, name="14036365{}0000.png")
    assert open_sequence(tmp_path).timestamps == [0.0, 0.1, 0.2]
    assert "10 Hz" in messages(caplog)[0]


def rename_eyes(folder, names):
    """Images of left and right get names (2,) that are formatted with their numbers."""
    for side, name in zip(("left", "right"), names, strict=True):
        for path in sorted((folder / side).iterdir()):
            path.rename(path.with_name(f"{name.format(int(path.stem))}.png"))


@pytest.mark.parametrize("names", [("cam0_{:04d}", "cam1_{:04d}"), ("{:d}_0", "{:d}_1"), ("2_a{}", "3_a{}")])
def test_the_number_of_the_camera_is_no_part_of_the_frame_s(tmp_path, names):
    make_folder(tmp_path, 12)
    rename_eyes(tmp_path, names)
    frames = read_all(tmp_path)[1]
    assert len(frames) == 12
    np.testing.assert_array_equal(frames[10].left, picture(10))
    np.testing.assert_array_equal(frames[10].right, picture(10, 1))


@pytest.mark.parametrize("names", [("run1_{}", "run3_{}"), ("cam1_{}", "cam0_{}"), ("20200101_{}", "20200102_{}")])
def test_other_numbers_that_differ_are_no_camera_s(tmp_path, names):
    make_folder(tmp_path, 3)
    rename_eyes(tmp_path, names)
    with pytest.raises(InputError, match="3 in left without partner"):
        open_sequence(tmp_path)


# KITTI


@pytest.mark.parametrize(
    ("left", "right", "cameras"),
    [
        ("image_0", "image_1", (0, 1)),
        ("image_l", "image_r", (0, 1)),
        ("image_left", "image_right", (0, 1)),
        ("image_2", "image_3", (2, 3)),
    ],
)
def test_kitti_folder_names_and_their_matrices(tmp_path, left, right, cameras):
    make_kitti(tmp_path, left=left, right=right)
    lines = [f"P{camera}: {kitti_line(t)}" for camera, t in enumerate((0, -5, 3, -4))]
    (tmp_path / "calib.txt").write_text("\n".join(lines))
    sequence = open_sequence(tmp_path)
    assert sequence.format == "kitti"
    assert sequence.camera.baseline == pytest.approx({(0, 1): 0.1, (2, 3): 0.14}[cameras])
    assert sequence.camera.is_rectified


def test_kitti_raw_layout(tmp_path):
    drive = make_kitti(tmp_path / "drive", 3, left="image_00/data", right="image_01/data", name="{:010d}.png")
    (drive / "times.txt").unlink()
    (drive / "calib.txt").unlink()
    (drive / "image_00" / "timestamps.txt").write_text(
        "2011-09-26 14:05:35.123456789\n2011-09-26 14:05:35.223456789\n2011-09-26 14:05:35.423456789\n"
    )
    with pytest.raises(CalibrationError, match=r"looked for .*calib.txt.*calib_cam_to_cam.txt"):
        open_sequence(drive)
    calibration = tmp_path / "calib_cam_to_cam.txt"
    calibration.write_text(
        "S_00: 80 60\nS_rect_00: 64 48\n" + f"P_rect_00: {kitti_line(0)}\nP_rect_01: {kitti_line(-5)}\n"
    )
    sequence = open_sequence(drive)
    assert sequence.timestamps[0] == pytest.approx(1317045935.123456789, abs=1e-6)
    np.testing.assert_allclose(np.diff(sequence.timestamps), [0.1, 0.2], atol=1e-6)
    calibration.write_text(calibration.read_text().replace("64 48", "100 50"))
    with pytest.raises(CalibrationError, match="images are 64x48, the calibration is for S_rect_00 100x50, S_00 80x60"):
        open_sequence(drive)


def test_kitti_frames_missing_on_both_sides_leave_a_gap(tmp_path):
    make_kitti(tmp_path)
    for eye in ("image_0", "image_1"):
        (tmp_path / eye / "000002.png").unlink()
    # The times of the whole recording are indexed by the frame number.
    assert open_sequence(tmp_path).timestamps == pytest.approx([0, 0.1, 0.3, 0.4, 0.5])
    (tmp_path / "times.txt").unlink()
    assert open_sequence(tmp_path).timestamps == pytest.approx([0, 0.1, 0.3, 0.4, 0.5])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected lines 'P0: ' and 'P1: '"),
        (f"P0: {kitti_line(0)}\n", "key 'P1' is missing; expected 12 numbers"),
        (f"P0: {kitti_line(0)} 1\nP1: {kitti_line(-5)}\n", r"key 'P0' must be 12 numbers .*\(size 13\)"),
        (f"P0: {kitti_line('x')}\nP1: {kitti_line(-5)}\n", "key 'P0' must be 12 numbers .*'x'"),
        (f"{kitti_line(0)}\n", "found 1 lines without a key"),
        (f"P0: {kitti_line(-5)}\nP1: {kitti_line(0)}\n", "left and right look swapped"),
        ("P0: 1 2 3 4 5 6 7 8 9 10 11 12\nP1: 1 2 3 4 5 6 7 8 9 10 11 12\n", "upper triangular"),
        ("P0: -5 0 3 0 0 5 2 0 0 0 1 0\n" + f"P1: {kitti_line(-5)}\n", "P0: focal lengths must be positive"),
    ],
)
def test_kitti_calibration_errors(tmp_path, text, message):
    make_kitti(tmp_path)
    (tmp_path / "calib.txt").write_text(text)
    with pytest.raises(CalibrationError, match=message) as caught:
        open_sequence(tmp_path)
    assert "calib.txt" in str(caught.value)


def test_kitti_eyes_of_different_sizes(tmp_path):
    make_kitti(tmp_path, 2)
    for path in (tmp_path / "image_1").iterdir():
        resize(path)
    with pytest.raises(CalibrationError, match=r"different sizes: .* is 64x48, .* is 30x20"):
        open_sequence(tmp_path)


# EuRoC


def test_euroc_pairs_by_nearest_stamp(tmp_path, caplog):
    left = [STAMP + 50_000_000 * index for index in range(20)]
    right = [stamp + 2_000_000 for stamp in left]
    del right[7]
    sequence, frames = read_all(make_euroc(tmp_path, left, right))
    assert sequence.format == "euroc"
    assert sequence.timestamps == [stamp / 10**9 for index, stamp in enumerate(left) if index != 7]
    np.testing.assert_array_equal(frames[7].left, picture(8, 0))
    np.testing.assert_array_equal(frames[7].right, picture(7, 1))
    assert [message for message in messages(caplog) if "without a partner" in message] == [
        f"{tmp_path}: 1 images without a partner within 5 ms are left out"
    ]


def test_euroc_unequal_counts(tmp_path):
    left = [STAMP + 50_000_000 * index for index in range(10)]
    with pytest.raises(InputError, match="unequal left and right images: 10 left, 8 right"):
        open_sequence(make_euroc(tmp_path / "a", left, left[:8], prefix="."))
    with pytest.raises(InputError, match="none of 10 left images has a right one within 5 ms"):
        open_sequence(make_euroc(tmp_path / "b", left, [stamp + 20_000_000 for stamp in left]))


def test_euroc_names_that_are_no_stamps_need_data_csv(tmp_path):
    make_euroc(tmp_path, [1, 2, 3], [1, 2, 3])
    with pytest.raises(InputError, match=r"names are no time stamps .*data.csv cannot be used"):
        open_sequence(tmp_path)
    rows = "#timestamp [ns],filename\n" + "".join(f"{STAMP + 10**8 * n},{n}.png\n" for n in (1, 2, 3))
    for eye in (0, 1):
        (tmp_path / "mav0" / f"cam{eye}" / "data.csv").write_text(rows)
    np.testing.assert_allclose(np.diff(open_sequence(tmp_path).timestamps), 0.1, atol=1e-6)
    (tmp_path / "mav0" / "cam1" / "data.csv").write_text(rows.replace("2.png", "9.png"))
    with pytest.raises(InputError, match=r"no time stamp for 1 images, the first is 2.png"):
        open_sequence(tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"intrinsics": [50, 50, 32]}, r"key 'intrinsics' must be 4 numbers in lists, got .* \(size 3\)"),
        ({"T_BS": {"cols": 4, "rows": 4, "data": [1, 2]}}, "key 'T_BS.data' must be 16 numbers"),
        ({"T_BS": {"cols": 4}}, "key 'T_BS.data' is missing"),
        ({"camera_model": "omni"}, "camera_model is 'omni', the omnidirectional model, which is not supported"),
        ({"distortion_model": "fov"}, "distortion_model is 'fov', the field-of-view model, which is not supported"),
        ({"distortion_coefficients": [0.1]}, "distortion has 1 coefficients"),
        ({"T_BS": {"data": [0.0] * 16}}, "T_BS of"),
    ],
)
def test_euroc_sensor_errors(tmp_path, changes, message):
    make_euroc(tmp_path, [STAMP], [STAMP])
    write_sensor(tmp_path / "mav0" / "cam0" / "sensor.yaml", 0.0, **changes)
    with pytest.raises(CalibrationError, match=message) as caught:
        open_sequence(tmp_path)
    assert "cam0/sensor.yaml" in str(caught.value)


def test_euroc_equidistant_and_missing_sensor(tmp_path):
    make_euroc(tmp_path, [STAMP], [STAMP])
    path = tmp_path / "mav0" / "cam1" / "sensor.yaml"
    write_sensor(path, 0.1, distortion_model="equidistant")
    assert open_sequence(tmp_path).camera.right.distortion_model == "equidistant"
    path.unlink()
    with pytest.raises(CalibrationError, match=r"cam1/sensor.yaml: cannot read the calibration"):
        open_sequence(tmp_path)


# Videos


RATE_HZ = 25.0


def smooth(index, eye, width=WIDTH):
    """A picture that survives JPEG."""
    u, v = np.meshgrid(np.arange(width), np.arange(HEIGHT))
    return np.clip(60 + u + v + 5 * index + 30 * eye, 0, 255).astype(np.uint8)


def check_video_frames(frames: list[StereoFrame], count):
    assert [frame.index for frame in frames] == list(range(count))
    np.testing.assert_allclose([frame.timestamp for frame in frames], np.arange(count) / RATE_HZ, atol=1e-3)
    for frame in frames:
        np.testing.assert_allclose(frame.left, smooth(frame.index, 0), atol=4)
        np.testing.assert_allclose(frame.right, smooth(frame.index, 1), atol=4)


@pytest.mark.parametrize("format", ["auto", "folder", "video"])
def test_two_videos(tmp_path, format):
    for eye, name in enumerate(("left.avi", "right.avi")):
        write_video(tmp_path / name, [smooth(index, eye) for index in range(7)], RATE_HZ)
    write_calibration(stereo_camera(), tmp_path / "calibration.yaml")
    sequence, frames = read_all(tmp_path, format=format)
    assert (sequence.format, sequence.length, sequence.timestamps) == ("video", 7, None)
    check_video_frames(frames, 7)
    with pytest.raises(InputError, match="is the video of one eye, the other lies beside it"):
        open_sequence(tmp_path / "left.avi", format="video")


def test_side_by_side_video(tmp_path):
    path = tmp_path / "both.avi"
    write_video(path, [np.hstack([smooth(index, 0), smooth(index, 1)]) for index in range(7)], RATE_HZ)
    with pytest.raises(CalibrationError, match="no calibration"):
        open_sequence(path)
    calibration = tmp_path / "elsewhere.yaml"
    write_calibration(stereo_camera(), calibration)
    sequence, frames = read_all(path, calibration=calibration)
    assert (sequence.format, sequence.source, sequence.length) == ("video", path, 7)
    check_video_frames(frames, 7)
    write_calibration(stereo_camera(128, 48), calibration)
    with pytest.raises(CalibrationError, match=r"left half\): left image is 64x48, the calibration is for 128x48"):
        open_sequence(path, calibration=calibration)


def test_videos_of_unequal_length(tmp_path):
    write_video(tmp_path / "left.avi", [smooth(index, 0) for index in range(7)], RATE_HZ)
    write_video(tmp_path / "right.avi", [smooth(index, 1) for index in range(5)], RATE_HZ)
    with pytest.raises(InputError, match=r"unequal left and right videos: 7 frames in .*, 5 in "):
        open_sequence(tmp_path)


def test_files_that_are_no_videos(tmp_path):
    (tmp_path / "empty.mp4").write_bytes(b"")
    with pytest.raises(InputError, match=r"empty.mp4: not a video that OpenCV can decode \(0 bytes\)"):
        open_sequence(tmp_path / "empty.mp4")
    cv2.imwrite(str(tmp_path / "left01.png"), picture(0))
    with pytest.raises(InputError, match="an image, not a video"):
        open_sequence(tmp_path / "left01.png")


@pytest.mark.parametrize(("factor", "unit"), [(1e9, "nanoseconds"), (1e6, "microseconds")])
def test_times_in_another_unit_are_refused(tmp_path, factor, unit):
    """They ended in a LinAlgError while tracking, or in a path of ten kilometres."""
    make_kitti(tmp_path)
    (tmp_path / "times.txt").write_text("".join(f"{0.1 * factor * k:.0f}\n" for k in range(6)))
    with pytest.raises(InputError, match=rf"times\.txt: times such as .* look like {unit}: write seconds"):
        open_sequence(tmp_path)


@pytest.mark.parametrize("stamp", ["9" * 19, "9" * 40])
def test_names_that_are_no_nanoseconds_are_refused(tmp_path, stamp):
    make_folder(tmp_path, 1, name=stamp + ".png")
    with pytest.raises(InputError, match=r"99\.png: 9+(\.\.\.)? is no time in nanoseconds since 1970"):
        open_sequence(tmp_path)


def test_a_key_of_kitti_that_stands_twice_is_refused(tmp_path):
    make_kitti(tmp_path)
    with (tmp_path / "calib.txt").open("a") as calibration:
        calibration.write(f"P1: {kitti_line(-9)}\n")
    with pytest.raises(CalibrationError, match=r"calib\.txt: key 'P1' stands twice"):
        open_sequence(tmp_path)


def test_kitti_cameras_without_an_inverse_are_refused(tmp_path):
    make_kitti(tmp_path)
    (tmp_path / "calib.txt").write_text(f"P0: {'0 ' * 12}\nP1: {kitti_line(-5)}\n")
    with pytest.raises(CalibrationError, match=r"calib\.txt: .*'P0'"):
        open_sequence(tmp_path)
