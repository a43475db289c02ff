import json
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.cli.report import report
from sigmaslam.errors import InputError
from sigmaslam.files import save_arrays
from sigmaslam.readers.trajectory_files import read_tum
from sigmaslam.report.report import write_report
from sigmaslam.run_record.evaluated_frames import EvaluatedFrames, write_evaluation
from sigmaslam.run_record.frame_table import STATUSES, read_frames
from sigmaslam.run_record.recorded_run import read_run
from sigmaslam.run_record.relative_pose_file import RELATIVE_POSES_NAME, FramePairs
from tests.support.pages import Page, unpack
from tests.support.recorded_runs import HEADER, STAGES, make_run

MOST_BYTES = 6_000_000


def _page(run: Path) -> Page:
    return Page(write_report(run).read_text(encoding="utf-8"))


def _text(run: Path) -> str:
    return _page(run).words


@pytest.mark.long
@pytest.mark.parametrize("count", [12, 1100, 30_000])
def test_report_is_one_file_that_needs_no_other(tmp_path, count):
    make_run(tmp_path / "run", count, pictures=count < 2000)
    weights = {f"network_{k}": {"file": "features.onnx", "sha256": "0" * 64} for k in range(500)}
    (tmp_path / "run/run.json").write_text(json.dumps({"weights": weights}))
    path = write_report(tmp_path / "run")
    assert path.stat().st_size <= MOST_BYTES
    page = Page(path.read_text(encoding="utf-8"))
    assert page.open == []
    assert all(link.startswith("data:") or (tmp_path / "run" / link).is_file() for link in page.links)
    assert len(page.identifiers) == len(set(page.identifiers))
    titles = [plot["title"] for plot in page.data["plots"]]
    assert titles == [
        "Error of the position [m]",
        "Error of the rotation [deg]",
        "NIS",
        "Matches and inliers",
        "Disparity offset [px]",
        "Time spent [ms]",
        "Belief",
    ]


def test_page_of_a_run_may_stand_elsewhere_without_links_to_its_files(tmp_path):
    make_run(tmp_path / "run")
    report([tmp_path / "run"], tmp_path / "page.html")
    assert all(link.startswith("data:") for link in Page((tmp_path / "page.html").read_text(encoding="utf-8")).links)
    assert not (tmp_path / "run/report.html").exists()
    report([tmp_path / "run"], tmp_path / "run/again.html")
    links = Page((tmp_path / "run/again.html").read_text(encoding="utf-8")).links
    assert {link for link in links if not link.startswith("data:")} >= {"frames.csv"}


def test_report_says_what_the_run_was(tmp_path):
    make_run(tmp_path / "run")
    text = _text(tmp_path / "run")
    assert "frames 200" in text
    assert "poses 199" in text
    assert "map points 20000" in text
    assert "keyframes 19 loops 1" in text
    assert "1 starting, 192 tracking, 5 lost, 1 relocalised, 1 skipped, 0 doubtful, 0 ambiguous." in text
    assert "disparity is 0.30 px <too small>; depth reads 1 % long" in text
    assert "<too small>" not in write_report(tmp_path / "run").read_text(encoding="utf-8")
    assert "sigmaslam track x" in text
    assert "Run run with losses" in text
    total = read_frames(tmp_path / "run/frames.csv").total_milliseconds
    assert f"speed {1000 / np.nanmedian(total):.1f} frames/s" in text
    p50, p95, p99 = np.nanpercentile(total, (50, 95, 99))
    assert f"p99 {p50:.0f}, {p95:.0f}, {p99:.0f} ms" in text


def test_poses_that_most_matches_contradict_are_told_of_at_first_sight(tmp_path):
    make_run(tmp_path / "run")
    path = tmp_path / "run/run.json"
    content = json.loads(path.read_text())
    assert "fewer than half of the matches" not in write_report(tmp_path / "run").read_text(encoding="utf-8")
    content["summary"] |= {"tracking": 192, "contradicted": 90}
    path.write_text(json.dumps(content))
    text = write_report(tmp_path / "run").read_text(encoding="utf-8")
    assert "In 90 of 192 tracked frames fewer than half of the matches" in text.partition("<noscript>")[0]


def test_a_failed_run_looks_failed(tmp_path):
    make_run(tmp_path / "run")
    path = tmp_path / "run/run.json"
    path.write_text(json.dumps({"summary": {"failure": "Nothing was tracked: swap the eyes."}, "ended": "complete"}))
    content = write_report(tmp_path / "run").read_text(encoding="utf-8")
    assert "<title>FAILED: run" in content
    assert '<body class="bad">' in content
    assert '<p class="notice bad">Nothing was tracked: swap the eyes.</p>' in content
    assert "Run run failed" in _text(tmp_path / "run")


def test_a_run_that_was_stopped_says_so(tmp_path):
    make_run(tmp_path / "run")
    (tmp_path / "run/run.json").write_text(json.dumps({"ended": "interrupted by SIGTERM"}))
    assert "did not come to its end: interrupted by SIGTERM." in _text(tmp_path / "run")


def test_a_run_that_went_on_says_from_where(tmp_path):
    """What it knew of its first part is gone."""
    make_run(tmp_path / "run")
    (tmp_path / "run/run.json").write_text(json.dumps({"resumed_at": [40, 80]}))
    assert "stopped and resumed at frame 40, 80" in _text(tmp_path / "run")


def test_ellipsoids_are_the_covariances_of_positions_in_the_world(tmp_path):
    make_run(tmp_path / "run")
    scene = _page(tmp_path / "run").data["scenes"][0]
    transforms = unpack(scene["ellipsoids"], 4, 4).astype(float)
    run = read_run(tmp_path / "run")
    rows = [np.linalg.norm(run.trajectory.positions - T[:3, 3], axis=1).argmin() for T in transforms]
    assert len(set(rows)) == len(transforms) == 40
    R = run.trajectory.rotations[rows]
    expected = R @ run.covariances[rows, :3, :3] @ R.transpose(0, 2, 1)
    found = transforms[:, :3, :3] @ transforms[:, :3, :3].transpose(0, 2, 1)
    np.testing.assert_allclose(found, expected, atol=1e-6 * expected.max())


def test_the_view_shows_path_keyframes_loop_and_points(tmp_path):
    make_run(tmp_path / "run", points=500)
    scene = _page(tmp_path / "run").data["scenes"][0]
    trajectory = read_tum(tmp_path / "run/trajectory.tum")
    np.testing.assert_allclose(unpack(scene["path"], 3), trajectory.positions, atol=1e-4)
    assert [STATUSES[k] for k in unpack(scene["path_status"])].count("lost") == 5
    # Every tenth frame is a keyframe; the skipped one, 50, has no pose.
    np.testing.assert_allclose(unpack(scene["keyframes"], 4, 4)[1], trajectory.poses[10], atol=1e-4)
    assert len(unpack(scene["keyframes"], 4, 4)) == 19
    np.testing.assert_allclose(unpack(scene["loops"], 2, 3), [trajectory.positions[[-1, 1]]], atol=1e-4)
    with np.load(tmp_path / "run/map.npz") as content:
        np.testing.assert_allclose(unpack(scene["points"], 3), content["points"], atol=1e-4)
        np.testing.assert_array_equal(unpack(scene["point_grey"]), content["intensity"])
    np.testing.assert_allclose(unpack(scene["point_sigma"]), 1.0)


def test_points_of_a_followed_body_are_where_it_was_last(tmp_path):
    make_run(tmp_path / "run", points=50)
    (tmp_path / "run/run.json").write_text(json.dumps({"object": {"region": "1,2,3,4", "origin": [0, 0, 1]}}))
    last = read_tum(tmp_path / "run/trajectory.tum").poses[-1]
    with np.load(tmp_path / "run/map.npz") as content:
        expected = content["points"] @ last[:3, :3].T + last[:3, 3]
    found = unpack(_page(tmp_path / "run").data["scenes"][0]["points"], 3)
    np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.long
def test_a_loss_of_one_frame_is_seen_in_a_long_run(tmp_path):
    make_run(tmp_path / "run", 45_000)
    path = tmp_path / "run/frames.csv"
    lines = path.read_text().splitlines()
    lines[7001] = lines[7001].replace("tracking", "lost")
    path.write_text("\n".join(lines) + "\n")
    scene = _page(tmp_path / "run").data["scenes"][0]
    assert [STATUSES[k] for k in unpack(scene["path_status"])].count("lost") == 6


def test_sigmas_are_those_of_the_covariance(tmp_path):
    make_run(tmp_path / "run")
    page = _page(tmp_path / "run")
    variances = np.diagonal(np.load(tmp_path / "run/covariance.npy"), axis1=1, axis2=2)
    for title, part, unit in (
        ("Error of the position", slice(0, 3), 1.0),
        ("Error of the rotation", slice(3, 6), 180 / np.pi),
    ):
        drawn = page.values(title, "3 sigma")
        assert np.flatnonzero(np.isnan(drawn)).tolist() == [50]
        np.testing.assert_allclose(np.delete(drawn, 50), 3 * unit * np.sqrt(variances[:, part].sum(axis=1)), rtol=1e-5)


def test_labels_and_head_say_how_well_the_last_second_is_known(tmp_path):
    make_run(tmp_path / "run")
    covariance = np.diag([9e-6, 16e-6, 0.0, 0.0, 0.0, np.radians(0.1) ** 2])
    pairs = FramePairs(
        np.array(["1 s", "1 m"]), np.zeros(2, int), np.full(2, 30), np.stack([np.eye(4)] * 2), [covariance] * 2
    )
    save_arrays(tmp_path / "run" / RELATIVE_POSES_NAME, **pairs.arrays())
    page = _page(tmp_path / "run")
    labels = page.data["scenes"][0]["labels"]
    assert labels[30].endswith("; over a second 5 mm, 0.1 deg")
    assert "over a second" not in labels[31]
    assert "sigma over a second 5 mm, 0.1°" in page.words


def test_lengths_and_errors_of_the_calibration_have_units(tmp_path):
    make_run(tmp_path / "run")
    covariances = np.load(tmp_path / "run/covariance.npy")
    covariances[20:23] = np.array([1590.0, 0.25, 0.003])[:, None, None] ** 2 * np.diag([1.0, 0, 0, 0, 0, 0])
    np.save(tmp_path / "run/covariance.npy", covariances)
    errors = {"yaw": [-1.62, 0.3], "baseline": [0.01, 0.003]}
    (tmp_path / "run/run.json").write_text(json.dumps({"summary": {"calibration_errors": errors}}))
    page = _page(tmp_path / "run")
    for label, sigma in zip(page.data["scenes"][0]["labels"][20:23], ("1590 m", "25 cm", "3 mm"), strict=True):
        assert f"sigma {sigma}, 0 deg" in label
    assert "yaw [px at 45°] -1.62 0.3 baseline +0.01 0.003" in page.words


def test_an_evaluation_is_in_the_report(tmp_path):
    make_run(tmp_path / "run")
    run, count = tmp_path / "run", 100
    row, line = np.arange(60, 60 + count), np.linspace(0, 1, count)
    frames = EvaluatedFrames(row, line, 0.1 * line, 2 * line + 0.1, np.column_stack([line, line, line]))
    ate = {"rmse": 0.1234, "rotation_rmse_deg": 0.5}
    errors = {"ate": ate, "ate_origin": ate, "rpe": {"translation_rmse": 0.01}, "nees": {"mean": 2.5, "inside": 0.4}}
    verdict = {"kind": "warn", "text": "NEES over 20 s is 16: so it is."}
    errors |= {"truth": "/home/me/room/poses.txt", "final": None}
    write_evaluation(run, {**errors, "truth_hint": None, "nees_verdict": verdict}, frames)
    page = _page(run)
    text = page.words
    html = (run / "report.html").read_text()
    assert '<div class="warn"><dt>NEES per dof' in html
    assert '<span class="state warn">' in html
    assert text.count(verdict["text"]) == 2
    assert "as it was said 0.1234 0.1234 0.5 0.01 2.50 40 %" in text
    assert "truth room/poses.txt ATE, best alignment 12.3 cm NEES per dof 2.50" in text
    # A frame is skipped before the first of them.
    np.testing.assert_allclose(page.values("Error of the position", "error")[61 : 61 + count], line, atol=1e-6)
    np.testing.assert_allclose(
        page.values("Error of the rotation", "error")[61 : 61 + count], np.degrees(0.1 * line), rtol=1e-5
    )
    np.testing.assert_allclose(page.values("NEES", "NEES / dof")[61 : 61 + count], 2 * line + 0.1, rtol=1e-5)
    np.testing.assert_allclose(unpack(page.data["scenes"][0]["truth"], 3)[:, 0], line, atol=1e-6)
    write_evaluation(run, {**errors, "truth_hint": "positions in mm", "nees_verdict": None}, frames)
    assert "The truth looks like positions in mm." in _text(run)
    assert '<span class="state warn">' in (run / "report.html").read_text()


def test_a_refinement_is_in_the_report(tmp_path):
    make_run(tmp_path / "run")
    found = {"keyframes": 7, "landmarks": 80, "observations": 900, "converged": True, "disparity_offset": 0.1}
    found |= {"disparity_offset_sigma": 0.02, "cost_per_dof_before": 3.0, "cost_per_dof_after": 1.25}
    (tmp_path / "run/refine.json").write_text(json.dumps(found))
    (tmp_path / "run/trajectory_refined.tum").write_text((tmp_path / "run/trajectory.tum").read_text())
    page = _page(tmp_path / "run")
    text = page.words
    assert "landmarks 80" in text
    assert "cost per dof 3 → 1.25" in text
    np.testing.assert_array_equal(
        unpack(page.data["scenes"][0]["refined"], 3), unpack(page.data["scenes"][0]["path"], 3)
    )


def test_runs_of_earlier_versions_have_a_report(tmp_path):
    make_run(tmp_path / "run", points=50)
    path = tmp_path / "run/frames.csv"
    rows = [line.split(",") for line in path.read_text().splitlines()]
    keep = [k for k, name in enumerate(rows[0]) if name not in ("keyframe", "loop")]
    path.write_text("\n".join(",".join(row[k] for k in keep) for row in rows) + "\n")
    np.savez(tmp_path / "run/map.npz", points=np.ones((4, 3)))
    (tmp_path / "run/covariance.npy").unlink()
    page = _page(tmp_path / "run")
    assert page.data["scenes"][0]["point_grey"] is None
    assert page.data["scenes"][0]["ellipsoids"]["base64"] == ""
    assert "keyframes" not in _text(tmp_path / "run").partition("Frames by status")[0]


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
    page = _page(tmp_path / "run")
    assert page.data["scenes"][0]["points"]["base64"] == ""
    assert "map.npz" not in page.links
    assert "run.json" not in _text(tmp_path / "run")


def test_run_with_only_skipped_frames_has_a_report(tmp_path):
    make_run(tmp_path / "run")
    empty = "," * (HEADER.count(",") - 1)
    (tmp_path / "run/frames.csv").write_text(f"{HEADER}\n0.0,skipped{empty}\n0.1,skipped{empty}\n")
    for name in ("trajectory.tum", "covariance.npy", "map.npz"):
        (tmp_path / "run" / name).unlink()
    page = _page(tmp_path / "run")
    assert page.data["plots"] == []
    assert page.data["scenes"] == []
    assert "2 skipped," in _text(tmp_path / "run")
    assert "Run run failed" in _text(tmp_path / "run")


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
