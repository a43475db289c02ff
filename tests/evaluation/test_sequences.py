"""The benchmark page."""

import os
import sys
from importlib.resources import as_file, files
from importlib.util import find_spec
from pathlib import Path

import pytest

from sigmaslam.errors import InputError
from sigmaslam_benchmarks.tracking import sequences
from sigmaslam_benchmarks.tracking.sequences import METHODS, run_sequences, write_sequences
from sigmaslam_benchmarks.tracking.sequences_page import method_label
from sigmaslam_synthetic.camera.rig import Miscalibration, Rig


def _rows(page: str, method: str) -> list[list[str]]:
    """Cells of the rows that begin with this method."""
    cells = ([cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines() if line.startswith("|"))
    return [row for row in cells if row[0] == method_label(method)]


@pytest.mark.long
def test_the_page_has_a_row_for_each_method_and_keeps_the_notes(tmp_path: Path):
    page = tmp_path / "results.md"
    page.write_text("old table\n<!-- notes -->\nkept words\n")
    text = write_sequences(page, None, "the command", ("klt", "klt-pnp"), ["demo"])
    assert text == page.read_text()
    assert "old table" not in text
    assert text.endswith("<!-- notes -->\nkept words\n")
    assert "`the command`" in text
    (tracker,) = _rows(text, "klt")
    (pnp,) = _rows(text, "klt-pnp")
    assert len(tracker) == len(pnp) == 9
    assert tracker[1] == pnp[1] == "39/39"
    assert float(pnp[2]) < 0.01  # metres of 0.8
    assert 0.0 < float(pnp[5]) < 10.0  # forward noise, millimetres of steps of 20
    # The baseline estimates no offset.
    assert pnp[7] == "-"
    assert float(pnp[6]) > 0


@pytest.mark.slow
def test_every_method_has_its_row(tmp_path: Path):
    pytest.importorskip("gtsam")
    text = write_sequences(tmp_path / "results.md", None, "the command", METHODS, ["demo"])
    for method in METHODS:
        if method == "cuvslam" and not find_spec("dim_odom"):
            continue
        if method == "orbslam3" and not (find_spec("pyorbslam3") and os.environ.get("PYORBSLAM3_VOCAB")):
            continue
        row = _rows(text, method)[0]
        assert len(row) == 9
        assert float(row[2]) < 0.02
    assert "keyframes" in _rows(text, "bundle")[0][1]


def test_without_gtsam_the_bundle_adjustment_is_left_out_with_a_note(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "gtsam", None)
    # Tracks that are there already, so that nothing is tracked.
    monkeypatch.setattr(sequences, "_track_ours", lambda sequence, run: run.mkdir(parents=True))
    text = write_sequences(tmp_path / "results.md", None, "the command", ("klt-pnp", "bundle"), ["demo"])
    assert _rows(text, "bundle") == []
    assert "*bundle adjustment* is left out: gtsam is not installed" in text
    assert len(_rows(text, "klt-pnp")) == 1


def test_a_peer_that_is_not_installed_is_left_out_with_a_note(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "dim_odom", None)
    text = write_sequences(tmp_path / "results.md", None, "the command", ("klt-pnp", "cuvslam"), ["demo"])
    assert _rows(text, "cuvslam") == []
    assert "*cuVSLAM* is left out: dim_odom" in text
    assert len(_rows(text, "klt-pnp")) == 1


@pytest.mark.long
def test_ours_says_how_consistent_its_relative_poses_are(tmp_path: Path):
    text = write_sequences(tmp_path / "results.md", None, "the command", ("ours", "klt-pnp"), ["demo"])
    assert text.count("Relative poses of *ours*; sigmas of the truth: exact.") == 1
    (row,) = (line.split("|")[1:-1] for line in text.splitlines() if line.startswith("| 1 s |"))
    assert 0.05 < float(row[2]) < 5.0  # NEES per degree of freedom; 1 is right
    assert float(row[3]) >= 80


def test_cuvslam_follows_the_demo(tmp_path: Path):
    pytest.importorskip("dim_odom")
    page = write_sequences(tmp_path / "results.md", None, "the command", ("cuvslam",), ["demo"])
    row = _rows(page, "cuvslam")[0]
    assert row[1] == "39/39"
    assert float(row[2]) < 0.01  # metres of 0.8
    assert 0.01 < float(row[6]) < 1.0  # NEES: it claims errors of 15 mm and makes 2
    assert "Covariance of *cuVSLAM* read as that of a step: NEES 0.0" in page


def test_the_right_calibration_of_the_street_has_the_offset_of_the_camera_that_took_it():
    with as_file(files("sigmaslam_synthetic") / "demo") as demo:
        written, right = (
            sequences._BenchmarkSequence("demo", demo, demo / "poses.txt", disparity_error=error).open().camera
            for error in (0.0, 0.3)
        )
    errors = Miscalibration(disparity_offset=0.3)
    taken_by = Rig(written.left, written.right, tuple(map(tuple, written.T_left_right)), errors).true_right
    assert right.right.cx == taken_by.cx
    assert right.left == written.left


def test_without_torch_the_renders_are_left_out_with_a_note(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fail(*_: object) -> None:
        raise ImportError(name="torch")

    monkeypatch.setattr(sequences, "render", fail)
    text = write_sequences(tmp_path / "results.md", None, "the command", ("klt-pnp",), ["demo", "street"])
    assert "street (rendered) is left out: torch is not installed" in text
    assert len(_rows(text, "klt-pnp")) == 1


def test_what_was_found_is_written_when_it_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sequences, "refine_run", interrupt)
    monkeypatch.setattr(sequences, "_track_ours", lambda sequence, run: run.mkdir(parents=True))
    page = tmp_path / "results.md"
    with pytest.raises(KeyboardInterrupt):
        write_sequences(page, None, "the command", ("klt-pnp", "bundle"), ["demo"])
    assert "Stopped before the end" in page.read_text()
    assert len(_rows(page.read_text(), "klt-pnp")) == 1


def test_a_folder_without_the_sequences_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="kitti_raw_0926_0039_a"):
        next(run_sequences(tmp_path, ["klt"]))


@pytest.mark.parametrize("names", [{"methods": ["magic"]}, {"sequences": ["magic"]}])
def test_an_unknown_name_is_refused_with_those_that_are_known(names: dict[str, list[str]]):
    with pytest.raises(InputError, match=r"'magic' is unknown; choose of (ours|demo), "):
        next(run_sequences(None, **names))
