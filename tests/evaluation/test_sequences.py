"""The benchmark page."""

import csv
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


def _beside(page: Path, name: str, method: str) -> str:
    """What a table beside the page has of this method on the demo."""
    with page.with_suffix(f".{name}.csv").open() as table:
        return dict(list(csv.reader(table))[1:])[method_label(method)]


def _demo(page: str, method: str) -> dict[str, str]:
    """What the page has of this method on the demo, its only sequence, by quantity."""
    rows = {}
    for section in page.split("\n## ")[1:]:
        for line in section.splitlines():
            if line.startswith(f"| {method_label(method)} |"):
                rows[section.partition("\n")[0]] = line.split("|")[2].strip()
    return rows


@pytest.mark.long
def test_the_page_has_a_row_for_each_method_and_keeps_the_notes(tmp_path: Path):
    page = tmp_path / "results.md"
    page.write_text("old table\n<!-- notes -->\nkept words\n")
    text = write_sequences(page, None, "the command", ("klt", "klt-pnp"), ["demo"])
    assert text == page.read_text()
    assert "old table" not in text
    assert text.endswith("<!-- notes -->\nkept words\n")
    assert "`the command`" in text
    pnp = _demo(text, "klt-pnp")
    assert _beside(page, "tracked", "klt") == _beside(page, "tracked", "klt-pnp") == "39/39"
    assert float(pnp["ATE, metres"]) < 0.01  # of 0.8
    assert 0.0 < float(_beside(page, "forward", "klt-pnp")) < 10.0  # of steps of 20
    offsets = (tmp_path / "results.offsets.csv").read_text()
    assert method_label("klt") in offsets
    assert method_label("klt-pnp") not in offsets  # the baseline estimates none
    assert float(pnp["NEES"]) > 0


@pytest.mark.slow
def test_every_method_has_its_row(tmp_path: Path):
    pytest.importorskip("gtsam")
    text = write_sequences(tmp_path / "results.md", None, "the command", METHODS, ["demo"])
    for method in METHODS:
        if method == "cuvslam" and not find_spec("dim_odom"):
            continue
        if method == "orbslam3" and not (find_spec("pyorbslam3") and os.environ.get("PYORBSLAM3_VOCAB")):
            continue
        assert float(_demo(text, method)["ATE, metres"]) < 0.02
    assert "keyframes" in _beside(tmp_path / "results.md", "tracked", "bundle")


def test_without_gtsam_the_bundle_adjustment_is_left_out_with_a_note(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "gtsam", None)
    # Tracks that are there already, so that nothing is tracked.
    monkeypatch.setattr(sequences, "_track_ours", lambda sequence, run: run.mkdir(parents=True))
    text = write_sequences(tmp_path / "results.md", None, "the command", ("klt-pnp", "bundle"), ["demo"])
    assert not _demo(text, "bundle")
    assert "demo: *bundle adjustment* is left out: gtsam is not installed" in text
    assert _demo(text, "klt-pnp")


def test_a_peer_that_is_not_installed_is_left_out_with_a_note(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "dim_odom", None)
    text = write_sequences(tmp_path / "results.md", None, "the command", ("klt-pnp", "cuvslam"), ["demo"])
    assert not _demo(text, "cuvslam")
    assert "demo: *cuVSLAM* is left out: dim_odom" in text
    assert _demo(text, "klt-pnp")


@pytest.mark.long
def test_ours_says_how_consistent_its_relative_poses_are(tmp_path: Path):
    write_sequences(tmp_path / "results.md", None, "the command", ("ours", "klt-pnp"), ["demo"])
    lines = (tmp_path / "results.relative.csv").read_text().splitlines()
    (row,) = (line.split(",") for line in lines if line.startswith("demo,1 s,"))
    assert 0.05 < float(row[3]) < 5.0  # NEES per degree of freedom; 1 is right
    assert float(row[4]) >= 80


def test_cuvslam_follows_the_demo(tmp_path: Path):
    pytest.importorskip("dim_odom")
    page = write_sequences(tmp_path / "results.md", None, "the command", ("cuvslam",), ["demo"])
    found = _demo(page, "cuvslam")
    assert _beside(tmp_path / "results.md", "tracked", "cuvslam") == "39/39"
    assert float(found["ATE, metres"]) < 0.01  # of 0.8
    assert 0.01 < float(found["NEES"]) < 1.0  # it claims errors of 15 mm and makes 2
    assert "*cuVSLAM*'s covariance as that of a step, mean NEES (median): demo 0.0" in page


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
    assert "street is left out: torch is not installed" in text
    assert _demo(text, "klt-pnp")


def test_what_was_found_is_written_when_it_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sequences, "refine_run", interrupt)
    monkeypatch.setattr(sequences, "_track_ours", lambda sequence, run: run.mkdir(parents=True))
    page = tmp_path / "results.md"
    with pytest.raises(KeyboardInterrupt):
        write_sequences(page, None, "the command", ("klt-pnp", "bundle"), ["demo"])
    assert "Stopped before the end" in page.read_text()
    assert _demo(page.read_text(), "klt-pnp")


def test_a_folder_without_the_sequences_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="kitti_raw_0926_0039_a"):
        next(run_sequences(tmp_path, ["klt"]))


@pytest.mark.parametrize("names", [{"methods": ["magic"]}, {"sequences": ["magic"]}])
def test_an_unknown_name_is_refused_with_those_that_are_known(names: dict[str, list[str]]):
    with pytest.raises(InputError, match=r"'magic' is unknown; choose of (ours|demo), "):
        next(run_sequences(None, **names))
