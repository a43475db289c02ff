"""The command line on the shipped sequence, and what it says to bad input."""

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.cli.commands import RENAMED
from sigmaslam.readers.trajectory_files import read_tum
from sigmaslam.run_record.relative_pose_file import read_frame_pairs
from tests.support.commands import Finished, assert_refused, command_line, environment, run_here, run_process
from tests.support.stopped_runs import hear_signals

FRAMES = 8


@pytest.fixture(scope="module")
def whole_sequence(demo_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first frames of the demo."""
    folder = tmp_path_factory.mktemp("whole") / "sequence"
    for name in ("image_0", "image_1"):
        (folder / name).mkdir(parents=True)
        for image in sorted((demo_sequence / name).iterdir())[:FRAMES]:
            shutil.copy(image, folder / name)
    shutil.copy(demo_sequence / "calib.txt", folder)
    for name in ("times.txt", "poses.txt"):
        lines = (demo_sequence / name).read_text().splitlines(keepends=True)
        (folder / name).write_text("".join(lines[:FRAMES]))
    return folder


@pytest.fixture(scope="module")
def tracked(whole_sequence: Path) -> tuple[Path, Finished]:
    """The run folder of these frames, and what the command said."""
    out = whole_sequence.with_name("run")
    return out, run_process("track", whole_sequence, "--out", out)


@pytest.fixture
def short_sequence(whole_sequence: Path, tmp_path: Path) -> Path:
    """The first frames of the demo, to be broken."""
    return shutil.copytree(whole_sequence, tmp_path / "sequence")


def rows(run: Path) -> list[list[str]]:
    return [line.split(",") for line in (run / "frames.csv").read_text().splitlines()[1:]]


@pytest.mark.long
def test_track_writes_every_output_and_evaluate_reads_them(whole_sequence: Path, tracked: tuple[Path, Finished]):
    out, result = tracked
    assert result.returncode == 0, result.stderr
    assert len(read_tum(out / "trajectory.tum")) == FRAMES
    assert len((out / "trajectory.kitti").read_text().splitlines()) == FRAMES
    covariance = np.load(out / "covariance.npy")
    assert covariance.shape == (FRAMES, 6, 6)
    assert (np.linalg.eigvalsh(covariance[1:]) > 0).all()
    matching = np.load(out / "covariance_matching.npy")
    assert (np.linalg.eigvalsh(covariance[1:] - matching[1:])[:, -1] > 0).all()  # the calibration is not exact
    assert len(rows(out)) == FRAMES
    pairs = read_frame_pairs(out / "relative_poses.npz", FRAMES)
    assert (pairs.earlier < pairs.later).all()
    with np.load(out / "map.npz") as archive:
        assert len(archive["points"]) == len(archive["covariances"]) == len(archive["observations"]) > 50
        vertices = len(archive["points"])
    assert f"element vertex {vertices}\n".encode() in (out / "map.ply").read_bytes()
    run = json.loads((out / "run.json").read_text())
    assert run["ended"] == "complete"
    assert run["calibration"]["sigmas"]["focal"] == 0.003
    assert len(run["weights_sha256"]["features.onnx"]) == 64
    assert 'id="scene"' in (out / "report.html").read_text()

    result = run_here("evaluate", out, "--truth", whole_sequence / "poses.txt", "--json")
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["matched"] == FRAMES


@pytest.mark.long
@pytest.mark.usefixtures("without_report")
def test_errors_of_the_calibration_are_estimated_where_they_are_named(short_sequence: Path, tmp_path: Path):
    result = run_here("track", short_sequence, "--out", tmp_path / "run", "--estimate", "yaw,focal")
    assert result.returncode == 0, result.stderr
    errors = json.loads((tmp_path / "run" / "run.json").read_text())["summary"]["calibration_errors"]
    assert set(errors) == {"yaw", "focal"}
    assert 0 < errors["focal"][1] <= 0.003
    refused = run_here("track", short_sequence, "--out", tmp_path / "other", "--estimate", "yow")
    assert_refused(refused, "--estimate", "yow", "yaw, pitch")


@pytest.mark.long
@pytest.mark.usefixtures("without_report")
def test_a_part_of_a_recording_is_tracked_in_small_and_may_replace_an_earlier_run(whole_sequence: Path, tmp_path: Path):
    out = tmp_path / "run"
    part = ("--start", "2", "--frames", "3", "--every", "2", "--scale", "0.5", "--frontend", "klt")
    assert run_here("track", whole_sequence, "--out", out, *part).returncode in (0, 3)
    times = np.loadtxt(whole_sequence / "times.txt")
    np.testing.assert_allclose([float(row[0]) for row in rows(out)], times[[2, 4, 6]], atol=1e-9)
    camera = json.loads((out / "run.json").read_text())["calibration"]["left"]
    stored = cv2.imread(str(next((whole_sequence / "image_0").iterdir())), cv2.IMREAD_GRAYSCALE)
    assert (2 * camera["height"], 2 * camera["width"]) == stored.shape
    assert_refused(run_here("track", whole_sequence, "--out", out, *part), "not an empty folder", "--overwrite")
    again = run_here("track", whole_sequence, "--out", out, "--overwrite", "--frames", "2", "--frontend", "klt")
    assert again.returncode in (0, 3)
    assert len(rows(out)) == 2
    (out / "notes.txt").write_text("mine")
    assert_refused(run_here("track", whole_sequence, "--out", out, "--overwrite"), "notes.txt")
    assert len(rows(out)) == 2


@pytest.mark.long
@pytest.mark.usefixtures("without_report")
def test_a_run_is_replaced_when_all_that_the_new_one_asks_for_is_read(whole_sequence: Path, tmp_path: Path):
    """Its own map, too."""
    out, few = tmp_path / "run", ("--frames", "12", "--overwrite")
    assert run_here("track", whole_sequence, "--out", out, *few).returncode == 0
    before = (out / "map.npz").read_bytes()
    assert_refused(run_here("track", whole_sequence, "--out", out, *few, "--map", "none.npz"), "none.npz")
    assert_refused(
        run_here("track", whole_sequence, "--out", out, *few, "--map", out, "--frontend", "sift"), "--frontend"
    )
    assert (out / "map.npz").read_bytes() == before
    assert run_here("track", whole_sequence, "--out", out, *few, "--map", out).returncode == 0
    assert (out / "map.npz").stat().st_size > 1.2 * len(before)
    assert "relocalised" in rows(out)[0]


@pytest.mark.long
def test_two_runs_are_identical_to_the_bit(whole_sequence: Path, tracked: tuple[Path, Finished], tmp_path: Path):
    assert run_process("track", whole_sequence, "--out", tmp_path / "again").returncode == 0
    for name in ("trajectory.tum", "trajectory.kitti", "covariance.npy", "map.ply"):
        assert (tracked[0] / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name


@pytest.mark.long
def test_a_missing_folder_is_refused(tmp_path: Path):
    assert_refused(run_process("track", tmp_path / "nowhere", "--out", tmp_path / "run"), "nowhere")
    assert not (tmp_path / "run").exists()


def test_unequal_counts_are_refused_with_both_numbers(short_sequence: Path, tmp_path: Path):
    sorted((short_sequence / "image_1").iterdir())[3].unlink()
    assert_refused(run_here("track", short_sequence, "--out", tmp_path / "run"), str(FRAMES), str(FRAMES - 1))


@pytest.mark.long
@pytest.mark.usefixtures("without_report")
@pytest.mark.parametrize("content", [b"", b"no image at all"])
def test_an_unreadable_image_costs_one_frame_and_a_warning(short_sequence: Path, tmp_path: Path, content: bytes):
    broken = sorted((short_sequence / "image_0").iterdir())[4]
    broken.write_bytes(content)
    out = tmp_path / "run"
    result = run_here("track", short_sequence, "--out", out)
    assert result.returncode == 0, result.stderr
    assert broken.name in result.stderr.replace("\n", "")
    assert [row[1] for row in rows(out)].count("skipped") == 1
    assert len(read_tum(out / "trajectory.tum")) == FRAMES - 1
    assert json.loads((out / "run.json").read_text())["summary"]["skipped"] == 1


def test_a_sequence_that_breaks_off_leaves_what_was_computed(short_sequence: Path, tmp_path: Path):
    """Time stamps that go back cannot be mended: exit code 2, and the frames before are on disk."""
    times = (short_sequence / "times.txt").read_text().splitlines()
    times[5] = "0.0"
    (short_sequence / "times.txt").write_text("\n".join(times) + "\n")
    out = tmp_path / "run"
    result = run_here("track", short_sequence, "--out", out)
    assert_refused(result, "time")
    if out.exists():  # a reader may refuse the file before the first frame
        assert len(read_tum(out / "trajectory.tum")) == len(read_tum(out / "trajectory_final.tum")) == 5
        assert np.load(out / "covariance_final.npy").shape == (5, 6, 6)


def test_a_calibration_with_a_missing_key_or_wrong_size_is_refused(short_sequence: Path, tmp_path: Path):
    calibration = short_sequence / "calib.txt"
    lines = calibration.read_text().splitlines()
    calibration.write_text(lines[0] + "\n")
    assert_refused(run_here("track", short_sequence, "--out", tmp_path / "run"), "calib.txt", "P1")
    calibration.write_text("\n".join([lines[0], " ".join(lines[1].split()[:-1])]) + "\n")
    assert_refused(run_here("track", short_sequence, "--out", tmp_path / "run"), "calib.txt", "12")


def test_a_calibration_for_another_image_size_is_refused(short_sequence: Path, tmp_path: Path):
    camera = {"width": 640, "height": 480, "fx": 400.0, "fy": 400.0, "cx": 320.0, "cy": 240.0}
    T = [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    calibration = tmp_path / "stereo.yaml"
    calibration.write_text(json.dumps({"left": camera, "right": camera, "T_left_right": T}))
    result = run_here("track", short_sequence, "--out", tmp_path / "run", "--calibration", calibration)
    assert_refused(result, "640x480", "320x240")


@pytest.mark.long
@pytest.mark.usefixtures("without_report")
@pytest.mark.parametrize("kind", ["colour", "16-bit"])
def test_colour_and_16_bit_images_are_converted_with_a_warning(short_sequence: Path, tmp_path: Path, kind: str):
    for path in [*(short_sequence / "image_0").iterdir(), *(short_sequence / "image_1").iterdir()]:
        grey = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert grey is not None
        image = cv2.merge([grey] * 3) if kind == "colour" else grey.astype(np.uint16) * 256
        cv2.imwrite(str(path), image)
    out = tmp_path / "run"
    result = run_here("track", short_sequence, "--out", out)
    assert result.returncode == 0, result.stderr
    assert ("colour" if kind == "colour" else "16") in result.stderr
    assert [row[1] for row in rows(out)].count("tracking") == FRAMES - 1


def test_an_output_folder_that_holds_something_is_refused_untouched(short_sequence: Path, tmp_path: Path):
    out = tmp_path / "run"
    out.mkdir()
    (out / "precious.txt").write_text("keep")
    assert_refused(run_here("track", short_sequence, "--out", out), str(out.name), "--out")
    assert [path.name for path in out.iterdir()] == ["precious.txt"]


@pytest.mark.long
def test_an_unknown_option_value_is_refused(short_sequence: Path, tmp_path: Path):
    assert_refused(
        run_process("track", short_sequence, "--out", tmp_path / "run", "--frontend", "surf"), "surf", "sift"
    )


@pytest.mark.long
def test_ctrl_c_leaves_a_usable_run(demo_sequence: Path, tmp_path: Path):
    out = tmp_path / "run"
    command = command_line("track", demo_sequence, "--out", out)
    process = subprocess.Popen(
        command, env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, preexec_fn=hear_signals
    )
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not ((out / "frames.csv").exists() and len(rows(out)) >= 3):
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=60) == 130
    assert json.loads((out / "run.json").read_text())["ended"] == "interrupted"
    count = len(read_tum(out / "trajectory.tum"))
    assert 3 <= count < 40
    assert len(np.load(out / "covariance.npy")) == count == len(rows(out))
    final = read_tum(out / "trajectory_final.tum")
    np.testing.assert_array_equal(final.timestamps, read_tum(out / "trajectory.tum").timestamps)
    assert np.load(out / "covariance_final.npy").shape == (count, 6, 6)


@pytest.mark.long
def test_the_runtime_needs_no_extra(demo_sequence: Path):
    """The whole path but training runs where only the runtime is installed."""
    script = (
        "import sys\n"
        "extras = 'torch kornia onnx onnxscript safetensors tensorboard scipy rosbags gtsam ray evo'.split()\n"
        "extras.append('matplotlib')\n"
        "class Absent:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.partition('.')[0] in extras:\n"
        "            raise ModuleNotFoundError(name)\n"
        "sys.meta_path.insert(0, Absent())\n"
        "import sigmaslam.cli, sigmaslam_evaluation.run_evaluation\n"
        "from sigmaslam import StereoTracker, open_sequence\n"
        f"sequence = open_sequence({str(demo_sequence)!r})\n"
        "tracker = StereoTracker(sequence.camera)\n"
        "statuses = [tracker.step(f.left, f.right, f.timestamp).status for f, _ in zip(sequence.frames(), range(3))]\n"
        "assert statuses == ['starting', 'tracking', 'tracking'], statuses\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=120, env=environment()
    )
    assert result.returncode == 0, result.stderr


@pytest.fixture
def without_matplotlib(tmp_path: Path) -> dict[str, str]:
    """Environment of a process in which matplotlib is not installed."""
    absent = tmp_path / "absent"
    absent.mkdir()
    (absent / "matplotlib.py").write_text(
        "raise ModuleNotFoundError(\"No module named 'matplotlib'\", name=__name__)\n"
    )
    return environment(absent)


@pytest.mark.long
def test_track_and_evaluate_need_no_matplotlib(
    whole_sequence: Path, tracked: tuple[Path, Finished], tmp_path: Path, without_matplotlib: dict[str, str]
):
    out, truth = tmp_path / "run", whole_sequence / "poses.txt"
    for arguments in (("track", whole_sequence, "--out", out), ("evaluate", out, "--truth", truth)):
        result = subprocess.run(
            command_line(*arguments), env=without_matplotlib, capture_output=True, text=True, check=False, timeout=120
        )
        assert result.returncode == 0, result.stderr
    assert "sigmaslam[report]" in result.stderr
    assert not (out / "evaluation.png").exists()
    page = (out / "report.html").read_text()
    assert 'id="scene"' in page

    for name in ("trajectory.tum", "trajectory_final.tum"):
        assert (out / name).read_bytes() == (tracked[0] / name).read_bytes()


@pytest.mark.long
def test_a_benchmark_that_draws_asks_for_matplotlib(tmp_path: Path, without_matplotlib: dict[str, str]):
    command = command_line("benchmark", "claims", "--out", tmp_path / "page.md")
    result = subprocess.run(command, env=without_matplotlib, capture_output=True, text=True, check=False, timeout=120)
    assert_refused(result, "matplotlib", "sigmaslam[report]")


@pytest.mark.long
def test_training_without_its_extra_says_how_to_install_it(tmp_path: Path):
    (tmp_path / "torch.py").write_text("raise ModuleNotFoundError(\"No module named 'torch'\", name='torch')\n")
    command = command_line("train", "--out", tmp_path / "run")
    result = subprocess.run(command, capture_output=True, text=True, env=environment(tmp_path), check=False, timeout=60)
    assert_refused(result, "sigmaslam[train]")


@pytest.mark.parametrize(
    "command",
    [
        "",
        "demo",
        "check",
        "track",
        "report",
        "evaluate",
        "calibrate",
        "calibrate board",
        "calibrate show",
        "calibrate convert",
        "calibrate rectify",
        "images",
        "images match",
        "images geometry",
        "images denoise",
        "map",
        "map refine",
        "map show",
        "map merge",
        "localize",
        "train",
        "train network",
        "train scorer",
        "train export",
        "train render",
        "benchmark",
        "benchmark sequences",
        "benchmark filters",
        "benchmark features",
        "benchmark runtime",
    ],
)
def test_every_command_has_help_that_80_columns_do_not_cut(command: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "80")
    result = run_here(*command.split(), "--help")
    assert result.returncode == 0
    assert "Usage" in result.stdout
    # Arguments of which there may be many end in dots.
    text = result.stdout.replace("IMAGES...", "IMAGES")
    assert not re.search(r"\w(…|\.\.\.)|<bool>", text), text


def test_the_list_of_columns_is_whole_in_80_columns(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "80")
    words = re.findall(r"\w+", run_here("track", "--help-all").stdout)
    assert {"timestamp", "qx", "qy", "qz", "qw", "sigma_position", "sigma_rotation"} <= set(words)


def test_help_of_track_is_a_screen_and_all_of_it_is_longer(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "80")
    short, whole = (run_here("track", option).stdout for option in ("--help", "--help-all"))
    assert len(short.splitlines()) <= 60
    assert "--denoise" not in short
    assert set(re.findall(r"--[a-z-]+", short)) < set(re.findall(r"--[a-z-]+", whole))


@pytest.mark.parametrize(("old", "new"), RENAMED.items())
def test_a_name_of_the_release_before_is_understood_with_a_word(old: str, new: str):
    result = run_here(old, "--help")
    assert result.stdout == run_here(*new.split(), "--help").stdout
    assert result.stderr == f"`sigmaslam {old}` is `sigmaslam {new}` now\n"


def test_a_group_with_a_command_of_its_own_goes_without_the_commands_name(tmp_path: Path):
    named, short = (run_here("calibrate", *board, tmp_path, "--out", "a.txt") for board in (["board"], []))
    assert_refused(short, "ends in .yaml")
    assert named.stderr == short.stderr
    assert "--recipe" in run_here("train", "--out", tmp_path, "--help").stdout


def test_the_list_of_commands_imports_none():
    code = "import sys; from sigmaslam.cli import main; main()"
    result = subprocess.run(
        [sys.executable, "-X", "importtime", "-c", code, "--help"],
        capture_output=True,
        text=True,
        env=environment(),
        check=True,
        timeout=60,
    )
    assert "reconstruct" not in result.stdout
    assert not re.search(r"\| +(numpy|cv2|onnxruntime|torch)$", result.stderr, re.MULTILINE)


@pytest.mark.long
def test_tab_completes_commands_options_and_choices():
    for typed, expected in (
        ("sigmaslam tr", {"track", "train"}),
        ("sigmaslam images tr", {"triangulate"}),
        ("sigmaslam track --fron", {"--frontend"}),
        ("sigmaslam track --frontend s", {"sift"}),
    ):
        words = {"_SIGMASLAM_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": str(typed.count(" "))}
        result = subprocess.run(
            [sys.executable, "-c", "import sys; sys.argv = ['sigmaslam']; from sigmaslam.cli import main; main()"],
            env={**environment(), **words},
            capture_output=True,
            text=True,
            check=False,
            timeout=60,
        )
        assert set(result.stdout.split()) == expected, result.stderr


def test_an_option_that_the_benchmark_does_not_serve_is_refused(tmp_path: Path):
    page = tmp_path / "page.md"
    for name, *flags in (
        ("claims", "--rounds", "3"),
        ("sequences", "--eager"),
        ("shake", "--runs", tmp_path, "--frames", "3"),
        ("shake", "--seeds", "3"),
    ):
        result = run_here("benchmark", name, "--out", page, *flags)
        assert result.returncode == 2
        assert ("--runs" if "--seeds" in flags else str(flags[-1 if len(flags) == 1 else -2])) in result.stderr
    assert not page.exists()
