"""The report of a run: one HTML file that needs nothing outside it."""

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from sigmaslam.files import atomic_write_text, printable
from sigmaslam.report import report_facts
from sigmaslam.report.page_parts import data_url, load_template, read_asset
from sigmaslam.report.report_plots import MAX_FRAMES, build_plots, thin
from sigmaslam.report.report_scene import build_scene
from sigmaslam.run_record.frame_pictures import FramePictures
from sigmaslam.run_record.frame_table import STATUSES, FrameTable
from sigmaslam.run_record.recorded_run import RecordedRun, read_run
from sigmaslam.run_record.run_folder import REPORT_NAME
from sigmaslam.run_record.verdict import contradiction_verdict

MAX_CONFIGURATION = 20_000
"""The report shows at most so many characters of run.json."""
PICTURE_MAGNIFICATION = 4
"""Ellipses of matches are drawn so many times as large; most are smaller than a pixel of the pictures."""
_OWN_SCRIPTS = "scene", "plots", "frames", "timeline", "page"
_SCRIPTS = "three-0.170.0.min.js", "uplot-1.6.32.min.js", *(f"{each}.js" for each in _OWN_SCRIPTS)
_STYLES = ("uplot-1.6.32.min.css", "report.css")
_LINKED = (
    ("trajectory.tum", "poses as they were said"),
    ("trajectory_final.tum", "after the fact"),
    ("trajectory_refined.tum", "after `refine`"),
    ("trajectory.kitti", "KITTI's form"),
    ("poses.csv", "time, pose, status, covariance"),
    ("covariance.npy", "of each pose"),
    ("relative_poses.npz", "relative to earlier keyframes"),
    ("frames.csv", "a row for each frame"),
    ("inertial.csv", "roll, pitch and biases"),
    ("map.ply", "points for viewers"),
    ("map.npz", "points and keyframes"),
    ("dense.npz", "surfaces shown here"),
    ("pictures.npz", "the frames shown here"),
    ("run.json", "settings and summary"),
    ("evaluation.json", "errors"),
    ("evaluation.png", "plots of errors"),
)


def write_report(run_dir: str | Path, out: Path | None = None) -> Path:
    """Write a page, `report.html` if not `out`, from a run folder's files, those of `evaluate` and `refine` included.

    Returns:
        The path of the report.
    Raises:
        InputError: frames.csv is missing, or a file is wrong.
    """
    folder = Path(run_dir)
    run = read_run(folder)
    scene, pictures, path = build_scene(run), _pictures(run), out or folder / REPORT_NAME
    state, (head, rows) = report_facts.judge(run), report_facts.list_evaluation(run)
    page = {
        "intervals": _intervals(run.frames),
        "statuses": STATUSES,
        "pictures": pictures,
        "picture_size": [] if run.pictures is None else run.pictures.size,
        "picture_magnification": PICTURE_MAGNIFICATION,
    }
    return write_page(
        path,
        "report.html",
        [run.frames.seconds],
        build_plots(run),
        [] if scene is None else [scene],
        page,
        name=printable(folder.resolve().name),
        kind=state.kind,
        state=state,
        facts=report_facts.list_facts(run),
        statuses=report_facts.list_statuses(run),
        contradiction=contradiction_verdict(run.summary),
        verdict=run.summary.get("calibration_verdict"),
        calibration=report_facts.list_calibration(run),
        inertial=report_facts.list_inertial(run),
        pictures=pictures,
        evaluation_head=head,
        evaluation_rows=rows,
        truth_hint=run.evaluation.get("truth_hint"),
        truth_notes=run.evaluation.get("truth_notes", ()),
        nees_verdict=run.evaluation.get("nees_verdict"),
        refinement=report_facts.list_refinement(run),
        machine=report_facts.list_machine(run),
        links=[each for each in _LINKED if path.parent.resolve() == folder.resolve() and (folder / each[0]).is_file()],
        configuration=_configuration(run.entries),
    )


def write_page(
    path: Path,
    template: str,
    seconds: list[np.ndarray],
    plots: list[dict[str, Any]],
    scenes: list[dict[str, Any]],
    page: dict[str, Any],
    **words: Any,
) -> Path:
    """Write a page of time line, view and plots, with its styles and scripts inside.

    Args:
        template: name of one that extends `page.html`.
        seconds: times of the frames of each run.
        plots: of `build_plots`; a series is of the run `run`, by default the first.
        scenes: of `build_scene`, of each run that has poses.
        page: what else the scripts need.
        **words: what else the template needs.
    """
    most = MAX_FRAMES // len(seconds)
    for series in (each for plot in plots for each in plot["series"]):
        series["values"] = thin(series["values"], most)
    page = {"seconds": [thin(each, most) for each in seconds], "plots": plots, "scenes": scenes, **page}
    text = load_template(template).render(
        scenes=scenes,
        plots=plots,
        styles=Markup("\n").join(read_asset(name) for name in _STYLES),
        scripts=[read_asset(name) for name in _SCRIPTS],
        # A "<" could end the script element in which the text stands.
        page=Markup(json.dumps(page, separators=(",", ":"), allow_nan=False, default=_pack).replace("<", "\\u003c")),
        **words,
    )
    atomic_write_text(path, text)
    return path


def _pack(array: np.ndarray) -> dict[str, str]:
    """An array for the JSON of a page; numbers become float32, and truth values and bytes uint8."""
    kind = "|u1" if array.dtype in (np.uint8, np.bool_) else "<f4"
    return {"dtype": kind, "base64": base64.b64encode(np.ascontiguousarray(array).astype(kind).tobytes()).decode()}


def _configuration(entries: dict[str, Any]) -> str | None:
    if not entries:
        return None
    text = json.dumps(entries, indent=2, ensure_ascii=False)
    return text if len(text) <= MAX_CONFIGURATION else text[:MAX_CONFIGURATION] + "\n… (run.json has more)"


def _intervals(frames: FrameTable) -> list[dict[str, Any]]:
    """Times of frames in a row that have the same status, but for those that are tracked."""
    seconds, status = frames.seconds, np.array(frames.status)
    half = 0.5 * float(np.median(np.diff(seconds))) if len(frames) > 1 else 0.5
    begins = np.flatnonzero(np.r_[True, status[1:] != status[:-1]])
    ends = np.r_[begins[1:], len(frames)] - 1
    return [
        {"first": float(seconds[first]) - half, "last": float(seconds[last]) + half, "status": str(status[first])}
        for first, last in zip(begins, ends, strict=True)
        if status[first] != "tracking"
    ]


def _pictures(run: RecordedRun) -> list[dict[str, Any]]:
    """The frames to look at, with what was matched in them."""
    pictures = run.pictures
    if pictures is None:
        return []
    timestamps = run.frames.columns["timestamp"]
    rows = np.searchsorted(timestamps, pictures.timestamp - 1e-6).clip(0, len(timestamps) - 1)
    worst = np.flatnonzero(pictures.worst)
    by_score = worst[np.argsort(-pictures.score[worst], kind="stable")].tolist()
    return [_picture(run, pictures, k, int(rows[k]), by_score) for k in range(len(pictures))]


def _picture(run: RecordedRun, pictures: FramePictures, index: int, row: int, worst: Sequence[int]) -> dict[str, Any]:
    """One of them; `row` in the table of frames, `worst` the indices of the worst ones in order."""
    frames = run.frames
    seconds, status, score = frames.seconds[row], frames.status[row], float(pictures.score[index])
    inliers, matches = (frames.columns[name][row] for name in ("inliers", "matches"))
    label = f"{seconds:.2f} s, frame {row}, {status}"
    if np.isfinite(matches):
        label += f", {inliers:.0f} of {matches:.0f} matches used"
    if np.isfinite(score):
        label += f", NIS {score:+.1f} sigma"
    part = pictures.matches(index)
    left, right = pictures.jpegs(index)
    return {
        "seconds": float(seconds),
        "label": label,
        "is_lost": status in ("lost", "starting") and index in worst,
        "rank": worst.index(index) if index in worst else None,
        "why": f"{status}, {seconds:.2f} s" if not np.isfinite(score) else f"NIS {score:+.1f} σ, {seconds:.2f} s",
        "left": data_url(left),
        "right": data_url(right) if right else None,
        "pixels": pictures.pixels[part],
        "covariance": pictures.covariance[part],
        "probability": pictures.probability[part],
        "inlier": pictures.inlier[part],
        "trail": pictures.trail[part],
    }
