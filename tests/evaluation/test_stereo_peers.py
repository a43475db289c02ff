"""Covariances and vocabularies of other people's odometry, and the folder of its runs."""

import time
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sigmaslam.errors import InputError
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import rotation_log, se3_exp
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers.trajectory_files import read_covariances, read_trajectory
from sigmaslam_benchmarks.tracking import stereo_peers
from sigmaslam_benchmarks.tracking.orb_vocabulary import BRANCHES, LEVELS, train_vocabulary
from sigmaslam_benchmarks.tracking.peer_run import PeerStep, write_peer_run
from sigmaslam_benchmarks.tracking.step_nees import step_nees
from sigmaslam_benchmarks.tracking.stereo_peers import MissingPeerError, OrbSlamProcess, body_covariance

CAMERA = RectifiedStereo(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480)


def test_a_covariance_about_fixed_axes_is_that_of_turns_of_the_body():
    angles = np.array([0.3, -0.5, 1.1])  # roll, pitch, yaw
    rotation = Rotation.from_euler("xyz", angles).as_matrix()
    for axis in range(6):
        change = np.zeros(6)
        change[axis] = 1e-6
        turned = Rotation.from_euler("xyz", angles + change[3:]).as_matrix()
        expected = np.concatenate([rotation.T @ change[:3], rotation_log(rotation.T @ turned)])
        found = body_covariance(np.outer(change, change), rotation)
        np.testing.assert_allclose(found, np.outer(expected, expected), atol=1e-17)


def test_errors_drawn_from_the_covariances_of_steps_have_a_nees_of_one():
    rng = np.random.default_rng(0)
    sigmas = np.array([0.03, 0.01, 0.02, 0.001, 0.002, 0.003])
    steps = se3_exp(rng.normal(0.0, 0.2, (2000, 6)))
    wrong = steps @ se3_exp(sigmas * rng.standard_normal((2000, 6)))
    poses, estimated = [np.eye(4)], [np.eye(4)]
    for true, found in zip(steps, wrong, strict=True):
        poses.append(poses[-1] @ true)
        estimated.append(estimated[-1] @ found)
    times = np.arange(2001.0)
    covariance = np.tile(np.diag(sigmas**2), (2001, 1, 1))
    covariance[0] = 0.0  # the first pose has none
    nees = step_nees(Trajectory(times, np.stack(estimated)), Trajectory(times, np.stack(poses)), covariance)
    assert len(nees) == 2000
    assert nees.mean() == pytest.approx(1.0, abs=0.06)  # 4.6 sigma of the mean


def test_a_run_has_the_covariances_of_its_poses_and_live_frames_wait_for_their_time(tmp_path: Path):
    times = [7.0, 7.04, 7.1]
    pairs = [SimpleNamespace(left=None, right=None, timestamp=moment) for moment in times]
    sequence: Any = SimpleNamespace(frames=lambda: pairs)
    moments: list[float] = []

    def step(left: object, right: object, timestamp: float) -> PeerStep:
        moments.append(time.perf_counter())
        pose = None if len(moments) == 2 else np.eye(4)
        return PeerStep(pose, "tracking", covariance=np.eye(6) * len(moments))

    began = time.perf_counter()
    peer: Any = SimpleNamespace(step=step)
    write_peer_run(sequence, tmp_path / "run", peer, live=True)
    assert (np.array(moments) - began >= np.array(times) - times[0]).all()
    trajectory = read_trajectory(tmp_path / "run" / "trajectory.tum")
    covariances = read_covariances(tmp_path / "run" / "covariance.npy", len(trajectory))
    np.testing.assert_array_equal(covariances[:, 0, 0], [1.0, 3.0])  # the second frame is lost


def test_a_vocabulary_is_a_tree_whose_words_are_at_its_ends():
    rng = np.random.default_rng(1)
    images = [rng.integers(0, 256, (200, 300), dtype=np.uint8) for _ in range(2)]
    text = train_vocabulary(images)
    head, *lines = text.split("\n")
    assert head == f"{BRANCHES} {LEVELS} 0 0"
    nodes = [line.split() for line in lines]
    assert {len(node) for node in nodes} == {2 + 32 + 1}
    parents = [int(node[0]) for node in nodes]
    assert all(parent <= number for number, parent in enumerate(parents))  # a parent's line is above its children's
    words = {number for number, node in enumerate(nodes, 1) if node[1] == "1"}
    assert words.isdisjoint(parents)
    assert words | set(parents) == set(range(len(nodes) + 1))
    assert max(Counter(parents).values()) <= BRANCHES
    assert len(words) > 100
    levels = [0]
    for parent in parents:
        levels.append(levels[parent] + 1)
    assert min(levels[word] for word in words) >= 2
    assert {float(nodes[word - 1][-1]) for word in words} == {0.0, round(float(np.log(2)), 6)}


def test_too_few_descriptors_make_no_vocabulary():
    with pytest.raises(InputError, match="1 images have 0 descriptors: give more"):
        train_vocabulary([np.zeros((100, 100), np.uint8)])


@pytest.mark.parametrize("own_process", [True, False])
def test_orb_slam3_has_its_own_process_unless_it_is_the_only_one_of_this(
    own_process: bool, monkeypatch: pytest.MonkeyPatch
):
    for name in ("OrbSlamPeer", "OrbSlamProcess"):
        monkeypatch.setattr(stereo_peers, name, lambda camera, rate, name=name: (name, rate))
    opened = stereo_peers.open_peer("orbslam3", CAMERA, [1.0, 1.05, 1.1, 2.0], own_process)
    assert opened == ("OrbSlamProcess" if own_process else "OrbSlamPeer", pytest.approx(20.0))


@pytest.mark.long
def test_orb_slam3_that_is_missing_says_so_from_its_own_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    # Neither a vocabulary in the cache nor a named one, where the package is installed.
    monkeypatch.setenv("PYORBSLAM3_CACHE", str(tmp_path))
    monkeypatch.delenv("PYORBSLAM3_VOCAB", raising=False)
    with pytest.raises(MissingPeerError, match=r"is not installed|its vocabulary is not here"):
        OrbSlamProcess(CAMERA, 20.0)
