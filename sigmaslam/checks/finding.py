"""What a check of the input found, and the reason that findings give for a failed run."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

Severity = Literal["ok", "unknown", "warning", "error"]

# A fault comes before its consequences: swapped eyes also have wrong rows.
_CAUSES_FIRST = (
    *("principal point", "focal length", "exposure", "light", "sharpness", "lines", "overlay", "same image"),
    *("mirrored", "overlap", "distortion", "synchronisation", "eyes", "rig", "rows", "rotation", "scale", "infinity"),
)


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check.

    Attributes:
        name: of the check, one or two words.
        severity: "ok"; "unknown", the input does not show it; "warning"; or "error", tracking will fail or be wrong.
        message: one line; names the value, and for warnings and errors the cure.
        figure: the value that was judged, None where there is none.
        pixels: by how much disparities may be off for it, 0 where it is corrected; None where that is not known.
        delay: seconds by which right images are late, if that is what is wrong, and part of a frame.
    """

    name: str
    severity: Severity
    message: str
    figure: float | None = None
    pixels: float | None = None
    delay: float = 0.0


# Faults that bend disparities, and by how many pixels where the check does not tell: what is searched across rows.
_OF_THE_EYES = frozenset({"mirrored", "distortion", "synchronisation", "eyes", "rig", "rotation", "scale", "infinity"})
_UNKNOWN_PIXELS = 2.0


def tracker_arguments(findings: Sequence[Finding]) -> dict[str, Any]:
    """What faults of the eyes that were found make `StereoTracker` know: `disparity_error` and `right_delay`."""
    faults = [each for each in findings if each.severity in ("warning", "error") and each.name in _OF_THE_EYES]
    pixels = [_UNKNOWN_PIXELS if each.pixels is None else each.pixels for each in faults]
    delay = sum(each.delay for each in findings)
    return {"disparity_error": max(filter(None, pixels), default=None), "right_delay": delay}


def wrong(findings: Sequence[Finding]) -> list[Finding]:
    """Warnings and errors, causes before their consequences, what does not hinder tracking last."""
    rank = {name: number for number, name in enumerate(_CAUSES_FIRST)}
    chosen = [each for each in findings if each.severity in ("warning", "error")]
    return sorted(chosen, key=lambda each: rank.get(each.name, len(rank)))


def has_errors(findings: Sequence[Finding]) -> bool:
    """Whether tracking will fail or be wrong."""
    return any(each.severity == "error" for each in findings)


def verdict(findings: Sequence[Finding]) -> tuple[Literal["good", "warn", "bad"], str]:
    """Kind, and in words, whether the input can be tracked."""
    if has_errors(findings):
        return "bad", "tracking would fail or be wrong"
    return ("warn", "look at the warnings before tracking") if wrong(findings) else ("good", "nothing is wrong")


def explain(findings: Sequence[Finding]) -> str:
    """Why a run on this input fails, a line for each reason: errors with the warnings that may have caused them.

    All warnings where there is no error; empty where there is neither.
    """
    ranked = [each for each in wrong(findings) if each.pixels != 0.0]  # what is corrected hinders nothing
    errors = [number for number, each in enumerate(ranked) if each.severity == "error"]
    chosen = [each for number, each in enumerate(ranked) if not errors or number <= errors[-1]]
    return "\n".join(each.message for each in chosen)
