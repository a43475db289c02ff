"""`sigmaslam check`, and what `sigmaslam track` makes of its findings."""

import json
import re
import shutil
from pathlib import Path

import pytest

from tests.support.commands import assert_refused, run_here

FRAMES = 12


def copy_demo(demo: Path, out: Path, left: str = "image_0", right: str = "image_1") -> Path:
    """The first frames of the demo with these folders as its eyes."""
    for source, name in ((left, "image_0"), (right, "image_1")):
        (out / name).mkdir(parents=True)
        for image in sorted((demo / source).iterdir())[:FRAMES]:
            shutil.copy(image, out / name)
    shutil.copy(demo / "calib.txt", out)
    lines = (demo / "times.txt").read_text().splitlines(keepends=True)
    (out / "times.txt").write_text("".join(lines[:FRAMES]))
    return out


@pytest.fixture(scope="module")
def swapped(demo_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo with its eyes exchanged."""
    return copy_demo(demo_sequence, tmp_path_factory.mktemp("eyes") / "[b]swapped<i>", "image_1", "image_0")


@pytest.mark.long
def test_check_prints_every_finding_and_writes_a_page_that_stands_alone(demo_sequence: Path, tmp_path: Path):
    result = run_here("check", demo_sequence, "--out", tmp_path / "page.html")
    assert result.returncode == 0, result.stderr
    for name in ("time stamps", "baseline", "eyes", "rows", "synchronisation"):
        assert name in result.stdout
    assert "error" not in result.stdout
    page = (tmp_path / "page.html").read_text()
    assert page.count("data:image/jpeg;base64,") == 4
    assert not re.search(r"""(src|href)=["'](?!data:)""", page)
    assert len(page) < 1_000_000


@pytest.mark.long
def test_check_ends_with_code_1_where_the_eyes_are_exchanged(swapped: Path, tmp_path: Path):
    result = run_here("check", swapped, "--out", tmp_path / "page.html")
    assert result.returncode == 1, result.stderr
    assert "swap the two" in " ".join(re.sub("[│┃]", " ", result.stdout).split())
    page = (tmp_path / "page.html").read_text()
    assert "swap the two" in page
    assert page.index("tracking would fail or be wrong") < page.index("swap the two") < page.index("<table>")
    assert "Verdict: tracking would fail or be wrong." in result.stdout
    assert "<i>" not in page


def test_check_of_what_cannot_be_read_ends_with_code_2(tmp_path: Path):
    assert_refused(run_here("check", tmp_path), "no stereo sequence of a known format")


def test_the_folder_of_one_eye_names_the_one_above(demo_sequence: Path):
    assert_refused(run_here("check", demo_sequence / "image_0"), f"give the folder above it, {demo_sequence}")


@pytest.mark.long
@pytest.mark.usefixtures("without_report")
def test_track_warns_before_it_starts_and_keeps_the_findings(swapped: Path, tmp_path: Path):
    result = run_here("track", swapped, "--out", tmp_path / "run")
    assert "left and right are exchanged" in " ".join(result.stderr.split())
    run = json.loads((tmp_path / "run" / "run.json").read_text())
    errors = [each for each in run["checks"] if each["severity"] == "error"]
    assert [each["name"] for each in errors] == ["eyes"]
    assert errors[0]["figure"] > 0.9
    assert "swap the two" in run["summary"]["calibration_verdict"]


def test_strict_refuses_before_anything_is_written(swapped: Path, tmp_path: Path):
    assert_refused(run_here("track", swapped, "--out", tmp_path / "run", "--strict"), "swap the two")
    assert not (tmp_path / "run").exists()
