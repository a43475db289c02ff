import json
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import rotation_exp
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers.trajectory_files import write_tum
from sigmaslam.runs.frame_table import read_frames
from sigmaslam.runs.report import write_report

STAGES = ("read", "features", "match", "filter", "map")
HEADER = (
    "timestamp,status,matches,inliers,nis,dof,belief,disparity_offset,disparity_offset_sigma,"
    "ms_read,ms_features,ms_match,ms_filter,ms_map"
)


def make_run(folder: Path, count: int = 200, points: int = 20000) -> None:
    """A run folder as `track` writes it, with lost, relocalised and skipped frames."""
    generator = np.random.default_rng(0)
    timestamps = 1403715273.26 + 0.1 * np.arange(count)
    angle = np.linspace(0, 5, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = rotation_exp(angle[:, None] * np.array([0.0, 1.0, 0.0]))
    poses[:, :3, 3] = 40 * np.column_stack([np.sin(angle), 0.02 * angle, 1 - np.cos(angle)])
    status = np.array(["tracking"] * count, dtype="<U12")
    status[0], status[count // 2 : count // 2 + 5], status[count // 2 + 5] = "starting", "lost", "relocalised"
    status[count // 4] = "skipped"
    rows = [HEADER]
    for k in range(count):
        if status[k] == "skipped":
            rows.append(f"{timestamps[k]:.9f},skipped" + "," * (HEADER.count(",") - 1))
            continue
        dof = int(generator.integers(200, 400))
        numbers = [dof, dof // 2, generator.chisquare(dof), dof, 1 - 0.1 * generator.random()]
        numbers += [-0.3 * (1 - np.exp(-k / 30)), 0.2 / (1 + k / 10), *generator.gamma(9, (0.3, 3, 1.2, 0.6, 0.5))]
        rows.append(f"{timestamps[k]:.9f},{status[k]}," + ",".join(f"{number:.5g}" for number in numbers))
    folder.mkdir(exist_ok=True)
    (folder / "frames.csv").write_text("\n".join(rows) + "\n")
    kept = status != "skipped"
    write_tum(folder / "trajectory.tum", Trajectory(timestamps[kept], poses[kept]))
    cloud = poses[generator.integers(0, count, points), :3, 3] + generator.normal(0, 8, (points, 3))
    np.savez(
        folder / "map.npz",
        points=cloud,
        covariances=np.tile(np.eye(3), (points, 1, 1)),
        observations=np.ones(points, dtype=np.int64),
    )
    summary = {"calibration_verdict": "disparity is 0.30 px <too small>; depth reads 1 % long"}
    (folder / "run.json").write_text(json.dumps({"versions": {"sigmaslam": "0.1.0"}, "summary": summary}))


class _Page(HTMLParser):
    """Checks that tags close and collects text, links and identifiers."""

    def __init__(self, content: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []
        self.links: list[str] = []
        self.identifiers: list[str] = []
        self.feed(content)

    def handle_starttag(self, tag, attrs):
        if tag not in ("meta", "br"):
            self.open.append(tag)
        self._attributes(attrs)

    def handle_startendtag(self, tag, attrs):
        self._attributes(attrs)

    def _attributes(self, attrs):
        self.links += [value for name, value in attrs if name in ("src", "href", "xlink:href")]
        self.identifiers += [value for name, value in attrs if name == "id"]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


@pytest.mark.parametrize("count", [12, 200, 1100, 5000])
def test_report_is_one_small_file(tmp_path, count):
    make_run(tmp_path / "run", count)
    weights = {f"network_{k}": {"file": "features.onnx", "sha256": "0" * 64} for k in range(500)}
    (tmp_path / "run/run.json").write_text(json.dumps({"weights": weights}))
    path = write_report(tmp_path / "run")
    content = path.read_text(encoding="utf-8")
    assert len(content.encode()) <= 300_000
    page = _Page(content)
    assert page.open == []
    assert all(link.startswith(("#", "data:image/png")) for link in page.links)
    assert len(page.identifiers) == len(set(page.identifiers))
    assert content.count("<svg") == 6


def test_report_says_what_the_run_was(tmp_path):
    make_run(tmp_path / "run")
    content = write_report(tmp_path / "run").read_text(encoding="utf-8")
    text = " ".join(" ".join(_Page(content).text).split())
    assert "frames 200" in text
    assert "poses 199" in text
    assert "map points 20000" in text
    assert "1 starting, 192 tracking, 5 lost, 1 relocalised, 1 skipped." in text
    assert "disparity is 0.30 px <too small>; depth reads 1 % long" in text
    assert "<too small>" not in content


def test_same_run_gives_the_same_report(tmp_path):
    make_run(tmp_path / "run")
    first = write_report(tmp_path / "run").read_bytes()
    assert write_report(tmp_path / "run").read_bytes() == first


def test_names_of_folders_are_escaped(tmp_path):
    make_run(tmp_path / "a<b>&c")
    content = write_report(tmp_path / "a<b>&c").read_text(encoding="utf-8")
    assert "a&lt;b&gt;&amp;c" in content
    assert "a<b>" not in content


def test_empty_fields_are_unknown_not_zero(tmp_path):
    make_run(tmp_path / "run")
    frames = read_frames(tmp_path / "run/frames.csv")
    skipped = frames.status.index("skipped")
    assert np.isnan(frames.columns["inliers"][skipped])
    assert np.isnan(frames.total_milliseconds[skipped])
    assert tuple(frames.milliseconds) == STAGES
    assert frames.seconds[-1] == pytest.approx(19.9)


def test_run_without_map_and_configuration_has_a_report(tmp_path):
    make_run(tmp_path / "run")
    (tmp_path / "run/map.npz").unlink()
    (tmp_path / "run/run.json").unlink()
    content = write_report(tmp_path / "run").read_text(encoding="utf-8")
    assert "map points" not in content
    assert "Configuration" not in content


def test_run_with_only_skipped_frames_has_a_report(tmp_path):
    make_run(tmp_path / "run")
    empty = "," * (HEADER.count(",") - 1)
    (tmp_path / "run/frames.csv").write_text(f"{HEADER}\n0.0,skipped{empty}\n0.1,skipped{empty}\n")
    content = write_report(tmp_path / "run").read_text(encoding="utf-8")
    assert content.count("<svg") == 1
    assert "2 skipped." in content


def test_empty_map_has_a_report(tmp_path):
    make_run(tmp_path / "run")
    np.savez(tmp_path / "run/map.npz", points=np.zeros((0, 3)))
    write_report(tmp_path / "run")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("0.000,starting", "0.000,dreaming", "line 2: status 'dreaming'"),
        (",belief,", ",faith,", "has no column belief"),
        ("1403715273.459999800,tracking,", "1403715273.459999800,tracking,x", "line 4: matches is 'x"),
        ("1403715273.459999800,", ",", "line 4: has no timestamp"),
    ],
)
def test_bad_frames_are_named_with_line_and_value(tmp_path, old, new, message):
    make_run(tmp_path / "run")
    path = tmp_path / "run/frames.csv"
    lines = path.read_text().splitlines()
    lines[1] = "0.000" + lines[1][lines[1].index(",") :]
    lines[3] = "1403715273.459999800" + lines[3][lines[3].index(",") :]
    text = "\n".join(lines)
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=r"frames\.csv: " + message):
        write_report(tmp_path / "run")


def test_missing_and_broken_files_are_named(tmp_path):
    with pytest.raises(InputError, match=r"frames\.csv: cannot read the frames: no such file"):
        write_report(tmp_path)
    make_run(tmp_path / "run")
    (tmp_path / "run/map.npz").write_text("none")
    with pytest.raises(InputError, match=r"map\.npz: is no numpy archive"):
        write_report(tmp_path / "run")
    (tmp_path / "run/map.npz").unlink()
    (tmp_path / "run/run.json").write_text("{")
    with pytest.raises(InputError, match=r"run\.json: is no JSON"):
        write_report(tmp_path / "run")
    (tmp_path / "run/frames.csv").unlink()
    with pytest.raises(InputError, match=r"frames\.csv: cannot read the frames"):
        write_report(tmp_path / "run")
