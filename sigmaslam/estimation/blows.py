"""Blows that a rig gets, by jumps of the specific force from sample to sample."""

from __future__ import annotations

import numpy as np

# A jump is a blow where it is so many times the usual one, and so large, m/s^2. In 105 s of a flight (EuRoC V1 01) the
# largest jump of 50 ms is at most 5.6 times the usual one; hands put a rig down by less than the second.
_UNUSUAL, _LEAST = 8.0, 5.0
# The usual jump is that of so many samples at least.
_LEAST_SAMPLES = 30


def find_blow(samples: np.ndarray, since: float) -> tuple[float, float] | None:
    """When the rig was hit, and by which jump of the force, m/s^2; None where it was not, or nothing tells.

    Args:
        samples: (N, 7) time, angular rate and specific force of the last while.
        since: time of the sensor's clock up to which jumps are known.
    """
    jumps, times = np.linalg.norm(np.diff(samples[:, 4:], axis=0), axis=1), samples[1:, 0]
    usual = jumps[times <= since]
    if len(usual) < _LEAST_SAMPLES or len(usual) == len(jumps):
        return None
    largest = len(usual) + int(np.argmax(jumps[len(usual) :]))
    bound = max(_UNUSUAL * float(np.sqrt(np.mean(usual**2))), _LEAST)
    return (float(times[largest]), float(jumps[largest])) if jumps[largest] > bound else None
