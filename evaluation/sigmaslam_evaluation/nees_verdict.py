"""What a NEES far from 1 means, in one sentence."""

import math
from collections.abc import Sequence

from sigmaslam_evaluation.metrics.relative_consistency import SpanConsistency
from sigmaslam_evaluation.metrics.trajectory_errors import PoseNees

# Errors of one run are correlated: a mean within this factor of 1 is no reason for a word.
_FAR = 3.0
# Fewer pairs overlap so much that they are one motion.
_FEWEST_PAIRS = 10
# Drift grows at least with the square root of time, from a span to one five times as long; the truth's noise does not.
_GROWS = 2.0


def judge_nees(nees: PoseNees | None, spans: Sequence[SpanConsistency] | None) -> dict[str, str] | None:
    """The span whose NEES is furthest from 1, and whose sigma is wrong there.

    Args:
        nees: of poses relative to the first.
        spans: of poses relative to earlier ones; what shows only the truth's errors, or has few pairs, does not count.
    Returns:
        "kind" ("warn": errors are larger than the sigmas say, "note": smaller) and "text"; None where all are near 1.
    """
    means = [] if nees is None else [("since the first pose", nees.mean, nees.median)]
    counted = [each for each in spans or () if each.count >= _FEWEST_PAIRS and not each.truth_rules]
    means += [(f"over {each.span}", each.mean_nees, each.median_nees) for each in counted]
    means = [each for each in means if each[1] > 0.0]
    if not means:
        return None
    where, mean, median = max(means, key=lambda each: abs(math.log(each[1])))
    exact = all(math.isnan(each.truth_share) for each in spans or ()) if nees is None else not nees.with_truth
    if mean < 1.0 / _FAR:
        whose = "truth" if any(each.truth_rules for each in spans or ()) else "estimate"
        whose = f"the {whose}'s sigma is too large, which is cautious"
        return {"kind": "note", "text": _sentence(where, mean, whose)}
    if mean <= _FAR:
        return None
    if median < 1.0:
        whose = f"a few frames are far off, while half of them have a NEES below {median:.2g}"
    else:
        whose = _name_the_small_sigma(exact, spans or ())
    return {"kind": "warn", "text": _sentence(where, mean, whose)}


def _sentence(where: str, mean: float, whose: str) -> str:
    shown = f"{mean:.0f}" if mean >= 10.0 else f"{mean:.2g}"
    return f"NEES {where} is {shown}, errors are {math.sqrt(mean):.2g} times what the sigmas say: {whose}."


def _name_the_small_sigma(exact: bool, spans: Sequence[SpanConsistency]) -> str:
    """Whose sigma is too small: noise of the truth is alike over all spans, a drift of the estimate grows."""
    if exact:
        return "the estimate's sigma is too small if the truth is exact, as is said (else --truth-kind gps or mocap)"
    times = [each for each in spans if each.span.endswith(" s")]
    if len(times) < 2:
        return "the estimate's sigma or the truth's is too small, the run is too short to tell"
    first, last = times[0], times[-1]
    if last.rotation_nees > last.translation_nees:
        grows = last.rotation_rmse_deg > _GROWS * first.rotation_rmse_deg
    else:
        grows = last.translation_rmse > _GROWS * first.translation_rmse
    if grows:
        return "the estimate's sigma is too small, as errors grow with time, which the truth's noise does not"
    return "the truth's sigma is too small (--truth-sigma-...), as errors do not grow with time as a drift does"
