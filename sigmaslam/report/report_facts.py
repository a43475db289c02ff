"""What a report says in words and figures."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sigmaslam.checks.finding import Finding, wrong
from sigmaslam.live.frame_drawing import format_length
from sigmaslam.report.report_plots import frame_interval, nis_per_dof
from sigmaslam.run_record.frame_table import RECKONED, STATUSES, TRACKED
from sigmaslam.run_record.real_time import format_latency
from sigmaslam.run_record.recorded_run import RecordedRun
from sigmaslam.run_record.verdict import doubts_verdict

Facts = list[tuple[str, str]]


@dataclass(frozen=True, slots=True)
class State:
    """How a run went, at first sight.

    Attributes:
        kind: "good", "warn" or "bad".
        word: one or two.
        notices: kind and text of what is to be said before all figures.
    """

    kind: str
    word: str
    notices: list[tuple[str, str]]


def judge(run: RecordedRun) -> State:
    """Failed, stopped, with losses, or good."""
    notices: list[tuple[str, str]] = []
    failure, ended = run.summary.get("failure"), run.entries.get("ended", "complete")
    tracked = run.frames.count(TRACKED)
    lost = run.frames.status.count("lost")
    if failure or not tracked:
        notices.append(("bad", failure or "No frame was tracked."))
    if ended != "complete":
        notices.append(("warn", f"The run did not come to its end: {ended}."))
    if lost and tracked:
        share = f"{lost} frames ({100 * lost / len(run.frames):.1f} %)"
        notices.append(("warn", f"Tracking was lost in {share}: poses there are predicted by the motion alone."))
    notices += [("warn", each) for each in doubts_verdict(run.summary)]
    findings = wrong([Finding(**each) for each in (*run.entries.get("checks", ()), *run.summary.get("imu", ()))])
    notices += [("warn", f"{each.name}: {each.message}") for each in findings if each.message not in (failure or "")]
    if hint := run.evaluation.get("truth_hint"):
        notices.append(("warn", f"The truth looks like {hint}."))
    verdict = run.evaluation.get("nees_verdict")
    if verdict and verdict["kind"] == "warn":
        notices.append(("warn", verdict["text"]))
    if failure or not tracked:
        return State("bad", "failed", notices)
    if ended != "complete":
        return State("warn", "stopped", notices)
    return State("warn" if notices else "good", "with losses" if lost else "tracked", notices)


def list_facts(run: RecordedRun) -> Facts:
    """Label and value of the summary."""
    frames = run.frames
    tracked = frames.count(TRACKED)
    facts = [
        ("frames", f"{len(frames)}"),
        ("tracked", f"{tracked} ({100 * tracked / len(frames):.0f} %)"),
        ("lost", f"{frames.status.count('lost')}"),
        ("poses", f"{len(run.trajectory)}"),
        ("duration", f"{frames.seconds[-1]:.1f} s"),
        ("path length", f"{run.trajectory.path_length:.2f} m"),
    ]
    if resumed := run.entries.get("resumed_at"):
        facts.append(("stopped and resumed", f"at frame {', '.join(map(str, resumed))}"))
    position, rotation = run.sigmas
    if len(position) and np.isfinite(position[-1]):
        facts.append(("sigma at the end", f"{format_length(position[-1])}, {np.degrees(rotation[-1]):.2g}°"))
    drift, turn = (_median(each) for each in run.sigmas_over_a_second)
    if drift is not None and turn is not None:
        facts.append(("sigma over a second", f"{format_length(drift)}, {np.degrees(turn):.2g}°"))
    facts += _errors(run)
    keyframes, inliers = frames.columns["keyframe"], frames.columns["inliers"]
    if np.isfinite(keyframes).any():
        facts.append(("keyframes", f"{np.nansum(keyframes):.0f}"))
        facts.append(("loops", f"{np.isfinite(frames.columns['loop']).sum()}"))
    facts += [
        ("median inliers", _number(_median(inliers[inliers > 0]), ".0f")),
        ("median NIS per dof", _number(_median(nis_per_dof(frames)), ".2f")),
    ]
    if run.map is not None:
        facts.append(("map points", f"{len(run.map.points)}"))
    return [*facts, *_speed(run)]


def list_statuses(run: RecordedRun) -> list[tuple[str, int]]:
    """Counts of frames; of those by sensors of motion only where there is one, as few rigs have any."""
    counts = [(status, run.frames.status.count(status)) for status in STATUSES]
    return [each for each in counts if each[1] or each[0] not in RECKONED]


def list_calibration(run: RecordedRun) -> list[tuple[str, str, str]]:
    """Name, value and standard deviation of the errors of the calibration in the end."""
    offset, sigma = (run.frames.columns[name] for name in ("disparity_offset", "disparity_offset_sigma"))
    known = np.flatnonzero(np.isfinite(offset))
    rows = []
    if len(known) and len(run.trajectory):
        rows.append(("disparity offset of these images [px]", f"{offset[known[-1]]:+.3f}", f"{sigma[known[-1]]:.3f}"))
    for name, (value, sigma) in (run.summary.get("calibration_errors") or {}).items():
        unit = "" if name in ("focal", "baseline") else " [px at 45°]"
        rows.append((name.replace("_", " ") + unit, f"{value:+.5g}", f"{sigma:.2g}"))
    return rows


def list_inertial(run: RecordedRun) -> Facts:
    """Label and value of an inertial sensor: its check, where up is, and the stretches in the dark."""
    rows = [(each["name"], each["message"]) for each in run.summary.get("imu", ())]
    gravity = run.summary.get("gravity")
    if gravity is not None:
        since = gravity["since"] - float(run.frames.columns["timestamp"][0])
        rows.append(("gravity", f"known since {since:.2f} s, in the world to {np.degrees(gravity['sigma']):.2f}°"))
    return rows + [(f"in the dark {k}", words) for k, words in enumerate(_dark_stretches(run), start=1)]


def _dark_stretches(run: RecordedRun) -> list[str]:
    """In words, the frames in a row that the inertial sensor alone carried, the longest first, at most eight."""
    dark = np.array(run.frames.status) == "inertial"
    edges = np.flatnonzero(np.diff(np.r_[False, dark, False].astype(int))).reshape(-1, 2)
    position, rotation = (run.of_frames(each) for each in run.sigmas)
    order = np.argsort(edges[:, 0] - edges[:, 1], kind="stable")[:8]
    return [
        f"{last - first} frames from {run.frames.seconds[first]:.2f} s to {run.frames.seconds[last - 1]:.2f} s, in the "
        f"end known to {format_length(position[last - 1])} and {np.degrees(rotation[last - 1]):.2g}°"
        for first, last in edges[order].tolist()
    ]


def list_machine(run: RecordedRun) -> Facts:
    """How the run was made, as far as run.json says."""
    entries = run.entries
    machine, versions = entries.get("machine") or {}, entries.get("versions") or {}
    rows = [
        ("command", entries.get("command")),
        ("started", entries.get("started")),
        ("ended", entries.get("ended")),
        ("input", entries.get("input")),
        ("front-end, back-end", ", ".join(str(entries[name]) for name in ("frontend", "backend") if name in entries)),
        ("world", run.summary.get("world")),
        ("machine", ", ".join(f"{value}" for value in (machine.get("processor"), machine.get("system")) if value)),
        ("cores", machine.get("cores")),
        ("versions", ", ".join(f"{name} {number}" for name, number in versions.items())),
    ]
    return [(label, f"{value}") for label, value in rows if value]


def list_evaluation(run: RecordedRun) -> tuple[list[str], list[list[str]]]:
    """Head and rows of the table of errors; no rows without an evaluation."""
    head = ["", "ATE [m]", "ATE, first pose [m]", "rotation [deg]", "RPE [m]", "NEES / dof", "inside 95 %"]
    rows = []
    for label, errors in (("as it was said", run.evaluation), ("after the fact", run.evaluation.get("final"))):
        if not errors:
            continue
        nees = errors.get("nees") or {}
        inside = nees.get("inside")
        rows.append(
            [
                label,
                _number(errors["ate"]["rmse"], ".4g"),
                _number(errors["ate_origin"]["rmse"], ".4g"),
                _number(errors["ate_origin"]["rotation_rmse_deg"], ".3g"),
                _number(errors["rpe"]["translation_rmse"], ".4g"),
                _number(nees.get("mean"), ".2f"),
                "–" if inside is None else f"{100 * inside:.0f} %",
            ]
        )
    return head, rows


def list_refinement(run: RecordedRun) -> Facts:
    """Label and value of what `sigmaslam map refine` found."""
    found = run.refinement
    if not found:
        return []
    before, after = (found.get(f"cost_per_dof_{name}") for name in ("before", "after"))
    return [
        ("keyframes", f"{found.get('keyframes')}"),
        ("landmarks", f"{found.get('landmarks')}"),
        ("observations", f"{found.get('observations')}"),
        ("cost per dof", f"{_number(before, '.3g')} → {_number(after, '.3g')}"),
        ("converged", "yes" if found.get("converged") else "no"),
        ("disparity offset", f"{found['disparity_offset']:+.3f} ± {found['disparity_offset_sigma']:.3f} px"),
    ]


def _errors(run: RecordedRun) -> Facts:
    if not run.evaluation:
        return []
    facts = [("truth", "/".join(Path(run.evaluation.get("truth", "?")).parts[-2:]))]
    facts.append(("ATE, best alignment", format_length(run.evaluation["ate"]["rmse"])))
    nees = run.evaluation.get("nees") or {}
    if nees.get("mean") is not None:
        facts.append(("NEES per dof", f"{nees['mean']:.2f}"))
    return facts


def _speed(run: RecordedRun) -> Facts:
    """Speed against that of the recording, and percentiles of latency, or of the time that frames took."""
    total = run.frames.total_milliseconds
    total = total[np.isfinite(total)]
    facts = []
    if len(total):
        # The first frame includes the time of loading.
        milliseconds = float(np.median(total))
        facts.append(("speed", f"{1000 / milliseconds:.1f} frames/s"))
        interval = frame_interval(run.frames)
        if interval:
            facts.append(("real time", f"{1e3 * interval / milliseconds:.2g} × {1 / interval:.3g} frames/s"))
    timing = run.entries.get("real_time")
    if isinstance(timing, dict):
        return [*facts, ("dropped", f"{timing['dropped']}"), ("latency", f"{format_latency(timing['latency_ms'])} ms")]
    if len(total):
        values = np.percentile(total, (50, 95, 99))
        facts.append(("time per frame, p50, p95, p99", ", ".join(f"{value:.0f}" for value in values) + " ms"))
    return facts


def _median(values: np.ndarray) -> float | None:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else None


def _number(value: float | None, form: str) -> str:
    return "–" if value is None or not np.isfinite(value) else format(value, form)
