"""Why a run has failed, in words."""

from collections.abc import Sequence
from typing import Any

from sigmaslam.checks.finding import Finding, explain


def explain_failure(summary: dict[str, Any], in_map: bool, started: bool, findings: Sequence[Finding]) -> str | None:
    """Why so little of a run, of which less than half of the frames were tracked without two answers; else None.

    Args:
        summary: counts of frames by status, under the names of the statuses, and of all under `frames`.
        in_map: poses were to be in the world of a map.
        started: a frame was good enough to define the world.
        findings: of a check of the input: where it found a fault, that is the reason.
    """
    frames, skipped = summary["frames"], summary["skipped"]
    # Of an ambiguous pose nobody knows whether it is right.
    tracked, ambiguous = summary["tracked"], summary["ambiguous"]
    if frames and 2 * (tracked - ambiguous) >= frames:
        return None
    if frames == skipped:
        return f"None of the {frames} frames could be read." if frames else "There was no frame."
    reasons = " ".join(explain(findings).splitlines())
    if tracked:
        unsure = f"{ambiguous} are ambiguous, " if ambiguous else ""
        counts = (
            f"Less than half of the frames were tracked{' with one answer' if ambiguous else ''}: "
            f"of {frames}, {unsure}{summary['lost']} are lost, "
            f"{summary['starting']} were before or at the start, {skipped} could not be read or show an image again."
        )
        return f"{counts} {reasons}".rstrip()
    if reasons:
        return f"Nothing was tracked: {reasons}"
    if in_map:
        return "The place was not found in the map: is it a map of this place, seen from where the camera is now?"
    if frames - skipped == 1:
        return "A single frame shows no motion: give two or more."
    if started:
        return (
            "Tracking started, but no later frame was recognised: do the frames follow each other, and does the "
            "calibration fit the camera?"
        )
    return (
        "Tracking never started: no frame has enough points that both cameras see. Are the left and right images "
        "swapped, dark or blurred, or is the calibration of another camera?"
    )
