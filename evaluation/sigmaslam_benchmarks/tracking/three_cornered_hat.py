"""Whose error is it? What the differences of three trackers and a measured truth say of each one's own part.

A three-cornered hat (Gray and Allan 1974): where errors of several sources are independent, the mean square of the
difference of any two is the sum of theirs; of four sources six differences give four parts by least squares. Errors
that sources share, as trackers share the calibration they are given, count as the others'.

    python -m sigmaslam_benchmarks.tracking.three_cornered_hat RECORDING > table.md
"""

import argparse
import tempfile
from collections.abc import Mapping
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.optimize import nnls

from sigmaslam.geometry.se3 import se3_inverse, se3_log
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers import open_sequence
from sigmaslam.readers.trajectory_files import read_trajectory
from sigmaslam.run_record.relative_pose_file import RELATIVE_POSES_NAME, read_frame_pairs
from sigmaslam_benchmarks.tracking.stereo_peers import track_with_peer
from sigmaslam_benchmarks.trial import track_ours
from sigmaslam_evaluation.metrics.trajectory_errors import associate
from sigmaslam_evaluation.truth_conventions import find_truth

_PEERS, _LENGTHS = ("cuvslam", "klt-pnp"), (10.0, 50.0, 100.0)  # metres
# Those of a camera: x right, y down, z ahead.
_COLUMNS = ("right m", "down m", "ahead m", "pitch deg", "yaw deg", "roll deg")
_UNITS = np.repeat([1.0, 180.0 / np.pi], 3)


def own_parts(relative: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[tuple[str, str], np.ndarray]]:
    """Root mean square error of each source, and of the difference of any two, (6,) each: metres, radians.

    Args:
        relative: (M, 4, 4) relative poses by source, at least three.
    """
    pairs = list(combinations(relative, 2))
    of_pair = [se3_log(se3_inverse(relative[one]) @ relative[other]) for one, other in pairs]
    squares = np.array([(each**2).mean(axis=0) for each in of_pair])
    design = np.array([[float(source in pair) for source in relative] for pair in pairs])
    parts = np.sqrt([nnls(design, column)[0] for column in squares.T]).T
    return dict(zip(relative, parts, strict=True)), dict(zip(pairs, np.sqrt(squares), strict=True))


def format_hat(runs: Path, truth: Trajectory) -> str:
    """Markdown of each source's own part over three distances, beside what ours says of itself.

    Args:
        runs: folder with a run of ours and of the peers, by their names.
        truth: measured poses.
    """
    found = {"truth": truth, **{name: read_trajectory(runs / name / "trajectory.tum") for name in ("ours", *_PEERS)}}
    # All have a pose where the table begins, and none loses one on what it is made of.
    rows = {name: dict(zip(*reversed(associate(each, truth)), strict=True)) for name, each in found.items()}
    shared = sorted(set.intersection(*map(set, rows.values())))
    poses = {name: found[name].poses[[rows[name][k] for k in shared]] for name in found}
    ahead = np.linalg.norm(np.diff(poses["truth"][:, :3, 3], axis=0), axis=1)
    path = np.concatenate([[0.0], np.cumsum(ahead)])
    said = read_frame_pairs(runs / "ours" / RELATIVE_POSES_NAME, len(found["ours"]))
    lines = [f"| over | root mean square of | {' | '.join(_COLUMNS)} |", "|---|---|" + "---:|" * len(_COLUMNS)]
    for length in _LENGTHS:
        later = np.searchsorted(path, path + length)
        earlier = np.flatnonzero(later < len(path))
        later = later[earlier]
        if not len(earlier):
            continue
        parts, differences = own_parts({name: se3_inverse(each[earlier]) @ each[later] for name, each in poses.items()})
        table = {f"{name}, own part": part for name, part in parts.items()}
        table |= {f"{one} - {other}": part for (one, other), part in differences.items()}
        claimed = said.covariance[said.span == f"{length:g} m"]
        if len(claimed):
            table["ours, sigma it says"] = np.sqrt(np.diagonal(claimed, axis1=1, axis2=2).mean(axis=0))
        for name, values in table.items():
            cells = " | ".join(f"{value:.3f}" for value in values * _UNITS)
            lines.append(f"| {length:g} m, {len(earlier)} pairs | {name} | {cells} |")
    return "\n".join(lines)


def main() -> None:
    """Tracks a recording with ours and two peers, and prints the table."""
    parser = argparse.ArgumentParser(
        prog="python -m sigmaslam_benchmarks.tracking.three_cornered_hat",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("recording", type=Path, help="folder of a drive, with its truth")
    recording = parser.parse_args().recording
    with tempfile.TemporaryDirectory() as folder:
        track_ours(open_sequence(recording), Path(folder) / "ours")
        for name in _PEERS:
            track_with_peer(open_sequence(recording), Path(folder) / name, name)
        print(format_hat(Path(folder), read_trajectory(find_truth(recording))))


if __name__ == "__main__":
    main()
