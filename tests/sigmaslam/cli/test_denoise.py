"""`sigmaslam images denoise` and `track --denoise`, on files."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.support.commands import assert_refused, run_here
from tests.support.tracked import track

ROOT = Path(__file__).resolve().parents[3]
DEMO = ROOT / "synthetic" / "sigmaslam_synthetic" / "demo"
SIGMA = 20.0


@pytest.fixture
def noisy_pairs(tmp_path: Path) -> Path:
    """Three pairs of the demo with noise."""
    folder, rng = tmp_path / "noisy", np.random.default_rng(0)
    for eye in ("image_0", "image_1"):
        (folder / eye).mkdir(parents=True)
        for name in ("000000.png", "000001.png", "000002.png"):
            image = cv2.imread(str(DEMO / eye / name), 0) + rng.normal(0.0, SIGMA, (240, 320))
            cv2.imwrite(str(folder / eye / name), np.clip(np.rint(image), 0, 255).astype(np.uint8))
    shutil.copy(DEMO / "calib.txt", folder)
    (folder / "times.txt").write_text("0.0\n0.05\n0.1\n")
    return folder


def rmse(path: Path, truth: Path) -> float:
    difference = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(float) - cv2.imread(str(truth), 0)
    return float(np.sqrt(np.mean(difference**2)))


@pytest.mark.parametrize("options", [[], ["--single"], ["--sigma", "20"]])
def test_the_images_of_a_folder_lose_most_of_their_noise(noisy_pairs: Path, tmp_path: Path, options: list[str]):
    done = run_here("images", "denoise", noisy_pairs / "image_0", "--out", tmp_path / "out", *options)
    assert done.returncode == 0, done.stderr
    sigma = float(done.stdout.split("sigma ")[1].split()[0].strip(","))
    assert sigma == pytest.approx(SIGMA, rel=0.2)
    files = sorted((tmp_path / "out").iterdir())
    assert [path.name for path in files] == ["000000.png", "000001.png", "000002.png"]
    for path in files:
        assert rmse(path, DEMO / "image_0" / path.name) < 0.5 * SIGMA


def test_a_bright_spot_in_16_bits_changes_no_other_pixel(tmp_path: Path):
    """2,100 is beyond eleven bits, which hold the rest of the sequence."""
    folder = tmp_path / "deep"
    folder.mkdir()
    for k in range(4):
        image = np.random.default_rng(k).normal(1000.0, 30.0, (120, 160))
        image[:6, :6] = 2100.0 if k == 2 else 1000.0
        cv2.imwrite(str(folder / f"{k}.png"), image.astype(np.uint16))
    assert run_here("images", "denoise", folder, "--out", tmp_path / "out").returncode == 0
    means = [cv2.imread(str(path), 0)[20:].mean() for path in sorted((tmp_path / "out").iterdir())]
    assert means == pytest.approx([1000.0 * 255 / 2047] * 4, rel=0.02)


def test_a_video_becomes_images(tmp_path: Path):
    video = cv2.VideoWriter(str(tmp_path / "one.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48), isColor=False)
    for k in range(3):
        video.write(np.full((48, 64), 50 * (k + 1), np.uint8))
    video.release()
    assert run_here("images", "denoise", tmp_path / "one.avi", "--out", tmp_path / "out").returncode == 0
    means = [cv2.imread(str(path), 0).mean() for path in sorted((tmp_path / "out").iterdir())]
    assert means == pytest.approx([50.0, 100.0, 150.0], abs=2.0)


@pytest.mark.long
def test_the_tracker_sees_filtered_images_and_the_run_says_so(noisy_pairs: Path, tmp_path: Path):
    track(noisy_pairs, tmp_path / "run", "orb", threads=1, denoise=True)
    noise = json.loads((tmp_path / "run" / "run.json").read_text())["noise"]
    assert len(noise) == 2
    for eye in noise:
        assert np.sqrt(eye["sigma"] ** 2 + eye["gain"] * 100) == pytest.approx(SIGMA, rel=0.25)


@pytest.mark.long
def test_what_cannot_be_filtered_is_refused(noisy_pairs: Path, tmp_path: Path):
    images = noisy_pairs / "image_0"
    cv2.imwrite(str(images / "000003.png"), np.zeros((64, 64), np.uint8))
    assert_refused(run_here("images", "denoise", images, "--out", tmp_path / "a"), "000003.png", "--single")
    cv2.imwrite(str(images / "000003.png"), np.zeros((20, 64), np.uint8))
    assert_refused(run_here("images", "denoise", images, "--single", "--out", tmp_path / "b"), "000003.png", "64x20")
    shutil.copy(images / "000000.png", images / "000000.bmp")
    assert_refused(run_here("images", "denoise", images, "--single", "--out", tmp_path / "c"), "000000.png", "rename")
    assert_refused(run_here("images", "denoise", tmp_path / "none", "--out", tmp_path / "d"), "no such file")
    for option in ("--sigma", "--gain"):
        found = run_here("images", "denoise", images, option, "inf", "--out", tmp_path / "g")
        assert found.returncode == 2
        assert f"Invalid value for '{option}'" in found.stderr
