"""Maps of two runs become one map, whose keyframes are where the truth says, within their covariance."""

from pathlib import Path

import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.estimation.marginalised_poses import past_slice
from sigmaslam.files import save_arrays
from sigmaslam.geometry.se3 import se3_inverse, se3_log, turn_covariance
from sigmaslam.readers.trajectory_files import read_kitti
from sigmaslam.runs.request import InputOptions, OutputOptions, TrackRequest
from sigmaslam.runs.track import track_sequence
from sigmaslam.slam.map_merging import MapFile, merge
from tests.support.commands import run_here


@pytest.mark.slow
def test_two_maps_become_one(demo_sequence: Path, tmp_path: Path, without_report: None):
    for name, some in (
        ("one", InputOptions(demo_sequence, frames=25)),
        ("other", InputOptions(demo_sequence, start=12)),
    ):
        track_sequence(TrackRequest(some, OutputOptions(tmp_path / name)))
    one, other = (MapFile(tmp_path / name) for name in ("one", "other"))
    said = run_here("map", "merge", str(tmp_path / "one"), str(other.path), "--out", str(tmp_path / "merged.npz"))
    assert said.returncode == 0, said.stderr
    assert said.stdout == run_here("map", "show", str(tmp_path / "merged.npz")).stdout
    assert f"keyframes  {len(one.known) + len(other.known)} within " in said.stdout
    merged = MapFile(tmp_path / "merged.npz")
    assert len(merged.known) == len(one.known) + len(other.known)
    assert len(merged.points.points) == len(one.points.points) + len(other.points.points)
    truth = read_kitti(demo_sequence / "poses.txt")
    times = np.loadtxt(demo_sequence / "times.txt")
    assert merged.hanging
    for keyframe in merged.hanging:
        exact = truth.poses[np.abs(times - keyframe.timestamp).argmin()]
        place = past_slice(keyframe.origin)
        covariance = turn_covariance(merged.past.poses[keyframe.origin], keyframe.covariance)
        covariance = covariance + merged.past.whole_covariance[place, place]
        error = se3_log(merged.pose(keyframe) @ se3_inverse(exact))
        assert np.linalg.norm(error[:3]) < 0.01
        assert error @ np.linalg.solve(covariance, error) < 22.5  # 99.9 %
    # The other way round.
    assert len(merge(other, one)["keyframe_poses"]) == len(merged.known)


@pytest.mark.slow
def test_maps_of_two_places_stay_two(demo_sequence: Path, tmp_path: Path, without_report: None):
    track_sequence(TrackRequest(InputOptions(demo_sequence, frames=25), OutputOptions(tmp_path / "one")))
    with np.load(tmp_path / "one" / "map.npz") as content:
        arrays = dict(content)
    # Another place: descriptors of other things.
    rng = np.random.default_rng(0)
    arrays["keyframe_descriptors"] = rng.permuted(arrays["keyframe_descriptors"], axis=1)
    save_arrays(tmp_path / "elsewhere.npz", **arrays)
    one, elsewhere = (MapFile(tmp_path / name) for name in ("one/map.npz", "elsewhere.npz"))
    with pytest.raises(InputError, match=r"elsewhere\.npz: 0 of .* keyframes are found"):
        merge(one, elsewhere)
