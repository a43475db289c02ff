"""What commands print of a run, and how they end after one that has failed."""

from pathlib import Path
from typing import Any

import typer

from sigmaslam.checks.finding import Finding, wrong
from sigmaslam.files import printable
from sigmaslam.run_record.verdict import contradiction_verdict, doubts_verdict, times_verdict

NOT_TRACKED = 3
"""Exit code where less than half of the frames were tracked."""


def tell_summary(summary: dict[str, Any], out: Path) -> None:
    """Prints the summary of a run.

    Raises:
        typer.Exit: less than half of the frames were tracked; the last line says why.
    """
    verdicts = [times_verdict(summary), contradiction_verdict(summary), *doubts_verdict(summary)]
    said = "".join(f"{each}\n" for each in verdicts if each)
    typer.echo(
        f"{summary['tracked']} of {summary['frames']} frames tracked{_doubted(summary)}, "
        f"{_reckoned(summary)}{summary['starting']} starting, {summary['lost']} lost, {summary['skipped']} skipped; "
        f"{summary['median_inliers']:.0f} inliers in the median frame, {summary['map_points']} map points.\n"
        f"{_world(summary)}{said}{summary['calibration_verdict']}\n"
        f"{_imu_verdict(summary)}{_location_verdict(summary)}{_real_time_verdict(summary)}"
        f"Report: {printable(out / 'report.html')}"
    )
    if summary["failure"] is not None:
        typer.echo(summary["failure"], err=True)
        raise typer.Exit(NOT_TRACKED)


def _world(summary: dict[str, Any]) -> str:
    """A line about the world, where it is not that of the first frame."""
    if not summary["first_frame_with_pose"] or summary["world"] is None:
        return ""
    return f"The world is {summary['world']}; frames before it have no pose.\n"


def _doubted(summary: dict[str, Any]) -> str:
    """How many of the poses are in doubt; empty where none is."""
    counts = [f"{summary[status]} {status}" for status in ("doubtful", "ambiguous") if summary[status]]
    return f" ({', '.join(counts)})" if counts else ""


def _reckoned(summary: dict[str, Any]) -> str:
    """How many frames a sensor of motion carried through the dark; empty where none."""
    names = {"inertial": "the inertial sensor", "odometry": "odometry"}
    return "".join(f"{summary[key]} by {name} alone, " for key, name in names.items() if summary.get(key))


def _imu_verdict(summary: dict[str, Any]) -> str:
    """Lines about an inertial sensor: what is wrong with it, or how it agrees, and how the camera is held."""
    findings = [Finding(**each) for each in summary.get("imu", ())]
    lines = [f"Inertial sensor, {each.name}: {each.message}" for each in wrong(findings)]
    if findings and not lines:
        lines = ["Inertial sensor: " + "; ".join(each.message for each in findings)]
    if "gravity" in summary:
        (roll, roll_sigma), (pitch, pitch_sigma) = (summary["gravity"][name] for name in ("roll_deg", "pitch_deg"))
        lines.append(
            f"In the end the camera has a roll of {roll:.1f} ± {roll_sigma:.1f} and a pitch of {pitch:.1f} ± "
            f"{pitch_sigma:.1f} degrees; T_gravity in run.json turns the world's z up."
        )
    return "".join(f"{each}\n" for each in lines)


def _location_verdict(summary: dict[str, Any]) -> str:
    """A line about the location sensor; empty without one."""
    if "location" not in summary:
        return ""
    used, weakened, unused, ready = (summary["location"][name] for name in ("used", "weakened", "unused", "ready"))
    if ready is None:
        return (
            f"The location sensor was not fused: its {used} readings with a pose do not show how its world lies to "
            "ours. Is it the same clock? Positions need a path that is no straight line.\n"
        )
    return (
        f"Location sensor: {used} readings used ({weakened} disagreed and count less), {unused} not; poses are fused "
        f"from {ready:.3f} s on.\n"
    )


def _real_time_verdict(summary: dict[str, Any]) -> str:
    """A line about dropped frames and latency; empty where frames were tracked as fast as they could be."""
    if "real_time" not in summary:
        return ""
    from sigmaslam.run_record.real_time import format_latency

    figures = format_latency(summary["real_time"]["latency_ms"])
    return f"In real time: {summary['real_time']['dropped']} frames dropped; latency in ms: {figures}.\n"
