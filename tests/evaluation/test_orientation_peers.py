"""The table of relative orientation where it is hard: its matches are as it says, and every method has its column."""

import numpy as np
import pytest

from sigmaslam_benchmarks.tracking import orientation_peers
from sigmaslam_benchmarks.tracking.orientation_peers import CASES, COUNT, SIGMA, hard_cases, simulate


def distances(name: str) -> np.ndarray:
    """(M,) of image 1's pixels from their true epipolar lines."""
    pair = simulate(CASES[name], 5)
    K_inverse = np.linalg.inv(pair.K)
    lines = (
        np.c_[pair.points0, np.ones(COUNT)] @ (K_inverse.T @ np.cross(np.eye(3), pair.direction) @ pair.R @ K_inverse).T
    )
    return np.abs((lines * np.c_[pair.points1, np.ones(COUNT)]).sum(axis=1)) / np.linalg.norm(lines[:, :2], axis=1)


@pytest.mark.parametrize("name", CASES)
def test_right_matches_lie_on_the_lines_of_the_pose_and_wrong_ones_anywhere(name: str):
    near = distances(name) < 6.0 * SIGMA
    assert near.mean() == pytest.approx(1.0 - CASES[name].wrong, abs=0.12)


def test_a_method_is_ahead_only_where_chance_does_not_make_it_so():
    ours = np.random.default_rng(0).gamma(4.0, 1.0, (40, 2))
    others = {"ours": list(ours), "alike": list(ours[::-1] * (0.99, 1.3)), "better": list(ours * (1.2, 0.4))}
    assert orientation_peers._ahead(others) == "better's direction"
    assert orientation_peers._ahead({"ours": list(ours), "worse": list(2.0 * ours)}) == "none"


@pytest.mark.long
@pytest.mark.parametrize("seed", [4, 6])
def test_a_match_that_decides_a_direction_alone_is_allowed_to_be_wrong(seed: int):
    """One of the wrong matches is on its line by chance, with a leverage of 1: its residual does not show it."""
    pair = simulate(CASES["forward, 70 %"], seed)
    R, direction, covariance = orientation_peers._ours(pair)
    assert orientation_peers._nees((R, direction, covariance), pair, covariance) < 4.0


@pytest.mark.slow
def test_the_table_has_a_row_a_case_and_says_what_is_not_installed(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(orientation_peers, "SEEDS", range(2))
    names = ("plane, 30 %", "forward, 20 %")
    monkeypatch.setattr(orientation_peers, "CASES", {name: CASES[name] for name in names})
    monkeypatch.setattr(orientation_peers, "find_spec", lambda module: None)
    told: list[str] = []
    found = hard_cases(None, told.append)
    plane, forward = found["hard_rows"]
    assert (plane[0], forward[0]) == names
    assert len(plane) == len(forward) == 6
    # Each case has its own matches.
    assert plane[1:] != forward[1:]
    assert found["not_installed"] == ["poselib", "pycolmap"]
    assert told == [f"{name} done" for name in names]
