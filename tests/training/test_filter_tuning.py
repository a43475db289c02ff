"""Training of the verifier's covariance through the filter, on the sequence that ships with the package."""

import copy
from importlib.resources import as_file, files
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from sigmaslam import StereoTracker
from sigmaslam.errors import InputError
from sigmaslam.models.export import load_verifier
from sigmaslam.models.verifier import MatchVerifier
from sigmaslam.readers import StereoFrame, open_sequence
from sigmaslam.rotation import se3_inverse
from sigmaslam.session import shipped_weights
from sigmaslam.tracker import Estimate
from sigmaslam.training import filter_tuning
from sigmaslam.training.filter_tuning import (
    RecordingTracker,
    UpdateRecord,
    assess,
    covariances,
    main,
    open_rendered,
    record_updates,
    tune,
)
from sigmaslam.trajectory import Trajectory

FRAMES = 4


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def demo():
    with as_file(files("sigmaslam.synthetic") / "demo") as folder:
        yield folder


@pytest.fixture(scope="module")
def frames(demo: Path) -> list[StereoFrame]:
    return list(islice(open_sequence(demo).frames(), FRAMES))


@pytest.fixture(scope="module")
def tracked(demo: Path, frames: list[StereoFrame]) -> tuple[RecordingTracker, list[Estimate]]:
    sequence, truth = open_rendered(demo)
    tracker = RecordingTracker(sequence.camera, truth)
    return tracker, [tracker.step(frame.left, frame.right, frame.timestamp) for frame in frames]


@pytest.fixture(scope="module")
def records(tracked: tuple[RecordingTracker, list[Estimate]]) -> list[UpdateRecord]:
    found = [record for record in tracked[0].records if record is not None]
    assert len(found) == FRAMES - 1
    return found


@pytest.fixture
def verifier() -> MatchVerifier:
    return load_verifier(shipped_weights("verifier.safetensors"))


def some_points(record: UpdateRecord) -> UpdateRecord:
    """Every fourth landmark, for speed."""
    kept = np.arange(len(record.points.landmarks)) % 4 == 0
    known = np.isfinite(record.points.measurement[:, 2])

    def part(inputs: tuple[np.ndarray, np.ndarray], index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return inputs[0][index], inputs[1][index]

    return UpdateRecord(
        record.prior,
        record.points.select(kept),
        part(record.matches, kept),
        part(record.landmarks, kept),
        part(record.disparities, kept[known]),
        record.intrinsics,
        record.T_key_camera,
    )


# Records


def test_recording_leaves_the_tracker_as_it_is(demo, frames, tracked):
    plain = StereoTracker(open_sequence(demo).camera)
    for frame, estimate in zip(frames[:2], tracked[1][:2], strict=True):
        expected = plain.step(frame.left, frame.right, frame.timestamp)
        np.testing.assert_array_equal(estimate.T_world_camera, expected.T_world_camera)
        np.testing.assert_array_equal(estimate.covariance, expected.covariance)


def test_records_are_the_updates_of_all_tracked_frames(tracked, records):
    updates = [estimate for estimate in tracked[1] if estimate.status == "tracking"]
    assert [len(record.points.landmarks) for record in records] == [estimate.inliers for estimate in updates]


def test_the_verifier_gives_the_noise_that_the_filter_had(verifier, records):
    for record in records:
        points, known = record.points, np.isfinite(record.points.measurement[:, 2])
        assert 100 < known.sum() < len(known)
        with torch.no_grad():
            matches, landmarks, disparities = (
                covariances(verifier, inputs).numpy()
                for inputs in (record.matches, record.landmarks, record.disparities)
            )
        size = np.trace(points.noise[:, :2, :2], axis1=1, axis2=2)
        assert (np.abs(matches - points.noise[:, :2, :2]).max(axis=(1, 2)) < 1e-5 * size).all()
        np.testing.assert_allclose(np.sqrt(landmarks[:, 0, 0]), points.landmark_sigma[:, 2], rtol=1e-5)
        np.testing.assert_allclose(disparities[:, 0, 0], points.noise[known, 2, 2], rtol=1e-5)


def test_the_true_pose_is_relative_to_the_keyframe(demo, frames, records):
    """The first frame is the keyframe of those after it; the demo needs no rectification."""
    _, truth = open_rendered(demo)
    for k, record in enumerate(records, start=1):
        assert frames[k].timestamp == pytest.approx(truth.timestamps[k])
        np.testing.assert_allclose(record.T_key_camera, se3_inverse(truth.poses[0]) @ truth.poses[k], atol=1e-9)


def test_updates_without_a_true_pose_are_left_out(demo, monkeypatch, caplog):
    sequence, truth = open_rendered(demo)
    late = Trajectory(truth.timestamps + 0.01, truth.poses)
    monkeypatch.setattr(filter_tuning, "open_rendered", lambda folder: (sequence, late))
    with pytest.raises(InputError, match="track more frames"):
        record_updates(demo, 2)
    assert "0 of 1 updates" in caplog.text


# Likelihood


def test_the_repeated_update_has_the_trackers_nis(verifier, tracked, records):
    updates = [estimate for estimate in tracked[1] if estimate.status == "tracking"]
    with torch.no_grad():
        found = [float(assess(verifier, record)[2]) for record in records]
    np.testing.assert_allclose(found, [estimate.nis / estimate.dof for estimate in updates], rtol=1e-4)


def test_a_pose_further_from_the_truth_is_less_likely(verifier, records):
    record = some_points(records[-1])
    moved = copy.copy(record.T_key_camera)
    moved[:3, 3] += 0.1
    other = UpdateRecord(
        record.prior,
        record.points,
        record.matches,
        record.landmarks,
        record.disparities,
        record.intrinsics,
        moved,
    )
    with torch.no_grad():
        loss, nees, nis = assess(verifier, record)
        worse, larger, same = assess(verifier, other)
    assert float(larger) > 10.0 * float(nees)
    # What the covariance has in the likelihood is the same.
    assert float(worse - loss) == pytest.approx(3.0 * float(larger - nees), rel=1e-9)
    assert float(nis) == float(same)


@pytest.mark.parametrize("axis", [0, 1])
def test_the_gradient_is_the_slope_of_the_loss(verifier, records, axis: int):
    verifier = verifier.double()
    record = some_points(records[-1])
    record = UpdateRecord(
        record.prior,
        record.points,
        *(
            (columns.astype(np.float64), axes)
            for columns, axes in (record.matches, record.landmarks, record.disparities)
        ),
        record.intrinsics,
        record.T_key_camera,
    )
    bias = verifier.layers[-1].bias
    loss, _, _ = assess(verifier, record)
    loss.backward()
    step, losses = 1e-4, []
    with torch.no_grad():
        for sign in (1.0, -1.0):
            bias[1 + axis] += sign * step
            losses.append(float(assess(verifier, record)[0]))
            bias[1 + axis] -= sign * step
    assert float(bias.grad[1 + axis]) == pytest.approx((losses[0] - losses[1]) / (2.0 * step), rel=1e-4)


# Training


def test_only_the_rows_of_log_sigma_move(verifier, records):
    before = {name: value.clone() for name, value in verifier.state_dict().items()}
    layer = verifier.layers[-1]
    for _ in islice(tune(verifier, [some_points(record) for record in records], 1, 0), 2):
        assert (layer.weight.grad[0] == 0).all()
        assert layer.bias.grad[0] == 0
        assert (layer.bias.grad[1:] != 0).all()
        assert all(p.grad is None for p in verifier.layers[:-1].parameters())
    for name, value in verifier.state_dict().items():
        if name.startswith("layers.4."):
            assert torch.equal(value[0], before[name][0])
            assert (value[1:] != before[name][1:]).any(dim=-1).all()
        else:
            assert torch.equal(value, before[name]), name


def test_a_few_steps_on_one_update_lower_its_loss(verifier, records):
    losses = list(tune(verifier, [some_points(records[-1])], 8, 0))
    assert len(losses) == 8
    assert min(losses[1:]) < losses[0]
    assert losses[-1] < losses[0]


def test_the_seed_orders_the_updates(verifier, records):
    some = [some_points(record) for record in records[:2]]
    first, second = (list(tune(copy.deepcopy(verifier), some, 1, 0)) for _ in range(2))
    assert first == second
    assert len(first) == 2


# Command


def test_the_command_writes_weights_that_load(demo, records, tmp_path, monkeypatch, capsys):
    some = [some_points(record) for record in records]
    # Tracking takes most of the time.
    monkeypatch.setattr(filter_tuning, "record_updates", lambda folder, frames: some[:frames])
    out = tmp_path / "tuned.safetensors"
    main(
        ["--train", str(demo), "--test", str(demo), "--out", str(out), "--frames", "2", "--epochs", "1", "--last", "1"]
    )
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:3] for line in lines[1:]] == [
        [epoch, name, "1"] for epoch in ("0", "1") for name in ("train", "test")
    ]
    tuned, shipped = load_verifier(out), load_file(shipped_weights("verifier.safetensors"))
    assert not torch.equal(tuned.layers[-1].weight, shipped["layers.4.weight"])
    assert torch.equal(tuned.layers[0].weight, shipped["layers.0.weight"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--out", "tuned.pt"], "end in .safetensors"),
        (["--out", "nowhere/tuned.safetensors"], "a folder that exists"),
        (["--epochs", "0"], "at least 1"),
        (["--frames", "0"], "at least 1"),
        (["--seed", "-1"], "at least 0"),
        (["--test", "."], "poses.txt"),
    ],
)
def test_what_cannot_be_done_is_refused_at_once(
    demo, tmp_path, monkeypatch, capsys, arguments: list[str], message: str
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        main(["--train", str(demo), "--test", str(demo), "--out", "tuned.safetensors", *arguments])
    assert stopped.value.code == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert "tracking" not in printed.err
    assert not printed.out
