"""Keyframes that left the window: kept within bounds, found again, and a map to localise in."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from threading import Event
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from sigmaslam import StereoTracker
from sigmaslam.bundle_adjustment.track_file import read_tracks
from sigmaslam.errors import InputError
from sigmaslam.estimation.marginalised_poses import PastPoses
from sigmaslam.estimation.state_layout import CALIBRATION_SIZE
from sigmaslam.frontend import Features, StereoView
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log, transform_points
from sigmaslam.readers.trajectory_files import read_kitti
from sigmaslam.slam import map_merging
from sigmaslam.slam.appearance import AppearanceIndex
from sigmaslam.slam.doubt import Doubt
from sigmaslam.slam.keyframe import HangingKeyframe, Keyframe, from_origin
from sigmaslam.slam.keyframes import Keyframes
from sigmaslam.slam.landmark_admission import AdmitAll
from sigmaslam.slam.map_file import pack_keyframes, read_keyframes
from sigmaslam.slam.map_merging import MapFile
from sigmaslam.slam.packed_view import PackedView
from sigmaslam.slam.place_recognition import retrieve
from sigmaslam.slam.point_map import PointMap
from sigmaslam.slam.relocalisation import Relocaliser
from sigmaslam.slam.tracker import TrackerConfig
from sigmaslam.two_view.stereo_pose import RelativePose
from sigmaslam_benchmarks.live.driver_faults import delay_right
from tests.support.dense_window import NO_WALK, make_window
from tests.support.estimates import Demo, error_of, mirrored, squared_error
from tests.support.faults import assert_no_pose
from tests.support.quantiles import WITHIN_3_SIGMA, squared_sigmas
from tests.support.tracked import track

CAMERA = RectifiedStereo(fx=200.0, fy=201.0, cx=32.0, cy=24.0, baseline=0.1, width=64, height=48)

NONE = np.zeros((6, CALIBRATION_SIZE))
ONE_POSE = PastPoses(np.eye(4)[None], np.eye(6), NONE, NONE)


def view_of(number: int, features: int = 40) -> StereoView:
    """A view with descriptors of its own."""
    rng = np.random.default_rng(number)
    descriptors = rng.normal(size=(features, 64)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    image = rng.integers(0, 256, (48, 64), dtype=np.uint8)
    found = Features(
        rng.uniform(0, 48, (features, 2)).astype(np.float32),
        descriptors,
        rng.uniform(size=features).astype(np.float32),
        rng.uniform(0.1, 1.0, features).astype(np.float32),
    )
    disparity = np.where(np.arange(features) % 4 == 0, np.nan, rng.uniform(1, 9, features))
    return StereoView(image, image, found, disparity, rng.uniform(0.1, 1, features))


def keyframe(number: int, features: int = 40) -> Keyframe:
    return Keyframe(number, 0.5 * number, view_of(number, features))


def looking(x: float, R: np.ndarray | None = None) -> np.ndarray:
    """Pose at (x, 0, 0) that looks along z by default."""
    pose = np.eye(4)
    pose[0, 3] = x
    pose[:3, :3] = np.eye(3) if R is None else R
    return pose


def visited(poses: list[np.ndarray], max_keyframes: int) -> Keyframes:
    """Keyframes at these poses that have all left the window."""
    window = make_window(np.zeros(3), camera=CAMERA)
    keyframes = Keyframes(window, max_keyframes, 100)
    for number, pose in enumerate(poses):
        window.add_keyframe(pose, pose, 1e-4 * np.eye(6), NO_WALK, 1.0)
        keyframes.append(view_of(number), 0.5 * number)
        keyframes.marginalise_oldest()
    return keyframes


def jittered(view: StereoView, rng: np.random.Generator) -> StereoView:
    """The same place seen again: descriptors a little different, in another order."""
    order = rng.permutation(len(view.features.descriptors))
    noisy = view.features.descriptors[order] + rng.normal(scale=0.03, size=(len(order), 64)).astype(np.float32)
    return replace(view, features=replace(view.features, descriptors=noisy))


# ---- memory


def test_memory_keeps_to_its_capacity_and_drops_the_right_images():
    for count in range(1, 12):
        kept = visited([looking(float(x)) for x in range(count)], 5).remembered
        assert len(kept) == min(count, 5)
        assert all(each.view.right.size == 0 for each in kept)
        assert all(each.view.left.shape == (48, 64) for each in kept)


def test_thinning_spares_places_visited_once():
    """Nine keyframes crowd at the origin, three places are visited once: all three stay, with their poses."""
    places = [0.0, 5.0, 0.01, 0.02, 10.0, 0.03, 0.04, 15.0, 0.05, 0.06, 0.07, 0.08]
    keyframes = visited([looking(x) for x in places], 6)
    assert {1, 4, 7} <= {each.id for each in keyframes.remembered}
    assert [T[0, 3] for T in keyframes.poses(keyframes.remembered)] == [
        places[each.id] for each in keyframes.remembered
    ]


def test_thinning_tells_directions_apart():
    """At one place, looking another way: what looks the same way goes first."""
    aside = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    poses = [looking(0.0), looking(0.0, aside), looking(0.01), looking(1.0)]
    assert 1 in {each.id for each in visited(poses, 3).remembered}


def test_keyframes_of_one_time_stamp_are_told_apart():
    """Two recordings may begin at zero: identity is a number, not a time."""
    window = make_window(np.zeros(3), camera=CAMERA)
    keyframes = Keyframes(window, 5, 100)
    for number in range(3):
        window.add_keyframe(looking(number), looking(number), 1e-4 * np.eye(6), NO_WALK, 1.0)
        keyframes.append(view_of(number), 0.0)
        keyframes.marginalise_oldest()
    assert [keyframes.index(each.id) for each in keyframes.remembered] == [0, 1, 2]
    assert [T[0, 3] for T in keyframes.poses(keyframes.remembered)] == [0.0, 1.0, 2.0]


def indexed(keyframes: list[Keyframe]) -> AppearanceIndex:
    index = AppearanceIndex()
    for each in keyframes:
        index.add(each.id, each.descriptors)
    return index


@pytest.mark.parametrize("wanted", [0, 3, 7, 150])
def test_the_most_similar_keyframe_is_the_one_that_shows_the_place(wanted: int):
    kept = [keyframe(number) for number in range(8 if wanted < 8 else 200)]
    best = retrieve(jittered(kept[wanted].view, np.random.default_rng(99)), 3, kept, indexed(kept))
    assert len(best) == 3
    assert best[0] is kept[wanted]


def test_nothing_is_similar_to_nothing():
    assert retrieve(view_of(0), 3, [], indexed([])) == []
    kept = [keyframe(1, features=0), keyframe(2)]
    assert retrieve(view_of(2), 1, kept, indexed(kept))[0] is kept[1]


# ---- map files


def test_keyframes_round_trip_through_a_file(tmp_path: Path):
    kept = [keyframe(0, 40), keyframe(3, 0), keyframe(4, 17)]
    rng, none = np.random.default_rng(0), np.zeros((18, CALIBRATION_SIZE))
    joint, common = rng.normal(size=(18, 18)), rng.normal(size=none.shape)
    past = PastPoses(np.stack([looking(x) for x in (0.0, 1.0, 2.0)]), joint @ joint.T, none, common)
    hung = [
        HangingKeyframe(1, 0.5, PackedView.of(view_of(1)), 4, se3_exp(rng.normal(size=6)), np.diag(rng.uniform(size=6)))
    ]
    np.savez_compressed(tmp_path / "map.npz", **pack_keyframes(kept, past, "learned", CAMERA, hung))
    read, past_read, hung_read = read_keyframes(tmp_path / "map.npz", "learned", CAMERA)
    assert [each.id for each in read] == [0, 1, 2]
    np.testing.assert_array_equal(past_read.poses, past.poses)
    # The next run may have another calibration: errors of this one are no longer told apart.
    np.testing.assert_array_equal(past_read.covariance, past.whole_covariance)
    np.testing.assert_array_equal(past_read.cross, none)
    np.testing.assert_array_equal(past_read.common, none)
    for before, after in zip(kept, read, strict=True):
        assert after.timestamp == before.timestamp
        _assert_close(PackedView.of(before.view).unpack(), after.view)
    (one,) = hung_read
    assert (one.id, one.timestamp, one.origin) == (3, 0.5, 2)
    np.testing.assert_allclose(one.step, hung[0].step, atol=1e-12)
    np.testing.assert_array_equal(one.covariance, hung[0].covariance)
    _assert_close(one.view, hung[0].view)


def _assert_close(one: StereoView, other: StereoView) -> None:
    np.testing.assert_array_equal(one.left, other.left)
    for name in ("disparity", "disparity_sigma"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    for name, array in one.features.arrays().items():
        np.testing.assert_array_equal(getattr(other.features, name), array)
        assert getattr(other.features, name).dtype == np.float32


def test_a_packed_view_is_about_the_view():
    """What has a disparity stays, best first; places are exact, descriptors within their steps, images within noise."""
    view = view_of(3, 400)
    smooth = cv2.GaussianBlur(view.left, (0, 0), 3.0)
    stereo = np.flatnonzero(np.isfinite(view.disparity))
    packed = PackedView.of(replace(view, left=smooth), 200)
    again = packed.unpack()
    assert len(again.disparity) == 200
    np.testing.assert_array_equal(again.features.keypoints, view.features.keypoints[stereo[:200]])
    np.testing.assert_allclose(again.disparity, view.disparity[stereo[:200]], rtol=1e-6)
    np.testing.assert_allclose(again.disparity_sigma, view.disparity_sigma[stereo[:200]], rtol=1e-3)
    similarity = np.sum(again.features.descriptors * view.features.descriptors[stereo[:200]], axis=1)
    assert similarity.min() > 0.98
    np.testing.assert_allclose(np.linalg.norm(again.features.descriptors, axis=1), 1.0, rtol=1e-5)
    assert np.abs(again.left.astype(int) - smooth).mean() < 3.0


# ---- more keyframes than poses are remembered together


def walked(
    places: np.ndarray, max_keyframes: int = 2400, path: Path | None = None, first: int = 0, sigma: float = 0.01
) -> Keyframes:
    """Keyframes at places (K,) along x that left the window, each known relative to the one before; in a map."""
    window = make_window(np.zeros(3), camera=CAMERA)
    keyframes = Keyframes(window, max_keyframes, 100)
    if path is not None:
        keyframes.load(path, "learned", CAMERA)
    for number, x in enumerate(places):
        step = looking(x - (places[number - 1] if number else 0.0))
        window.add_keyframe(looking(x), step, sigma**2 * np.eye(6), NO_WALK, 1.0)
        keyframes.append(view_of(first + number), 0.5 * number)
        if number:
            keyframes.marginalise_oldest()
    return keyframes


@pytest.mark.long
def test_keyframes_beyond_the_remembered_poses_hang_at_neighbours():
    """All stay known, each where it was, and what is uncertain between it and its neighbour is kept."""
    places = 0.1 * np.arange(151)
    keyframes = walked(places, 600)
    assert len(keyframes.remembered) == 60
    known = keyframes.left_long_ago()
    assert [each.id for each in known] == list(range(150))
    np.testing.assert_allclose(keyframes.poses(known)[:, 0, 3], places[:150], atol=1e-9)
    assert len(keyframes.appearance) == 150
    past = keyframes._window.posterior.past
    for each in keyframes.hanging.values():
        # Each step adds 0.01^2 to every variance.
        steps = abs(each.id - each.origin)
        assert 1 <= steps <= 4
        assert each.covariance[0, 0] >= 0.99 * steps * 0.01**2
        assert each.covariance[0, 0] <= 7 * 0.01**2
        seen = from_origin(each, RelativePose(looking(0.2), np.ones(3, bool), 1e-6 * np.eye(6), 1.0))
        T = past.poses[keyframes.index(each.origin)] @ seen.T_key_camera
        np.testing.assert_allclose(T, looking(places[each.id] + 0.2), atol=1e-9)
        assert seen.covariance[0, 0] == pytest.approx(each.covariance[0, 0] + 1e-6)


@pytest.mark.long
def test_what_is_as_well_known_to_all_hangs_at_a_near_one():
    """Steps without error: every neighbour is as good, and the nearest is taken."""
    keyframes = walked(0.1 * np.arange(151), 2400, sigma=1e-9)
    assert max(abs(each.id - each.origin) for each in keyframes.hanging.values()) <= 4


@pytest.mark.long
@pytest.mark.parametrize("most", [60, 180])
def test_no_more_keyframes_hang_than_are_asked_for(most: int):
    keyframes = walked(0.1 * np.arange(221), most)
    known = keyframes.left_long_ago()
    assert 0.6 * most <= len(known) <= most
    assert len(keyframes.appearance) == len(known)
    assert {each.origin for each in known} <= {each.id for each in keyframes.remembered}


@pytest.mark.long
def test_keyframes_are_forgotten_where_most_hang_and_only_for_want_of_room(tmp_path: Path):
    """All of a map that was joined hang at one keyframe."""
    arrays = walked(0.1 * np.arange(150), 240).pack("learned", CAMERA)
    arrays["keyframe_origins"][61:] = 7
    np.savez_compressed(tmp_path / "map.npz", **arrays)
    keyframes = walked(0.1 * np.arange(75) + 15.0, 240, tmp_path / "map.npz", first=150)
    assert len(keyframes.left_long_ago()) == 149 + 75
    keyframes = walked(0.1 * np.arange(120) + 15.0, 240, tmp_path / "map.npz", first=150)
    assert len(keyframes.left_long_ago()) == 240
    gone = set(range(268)) - {each.id for each in keyframes.left_long_ago()}
    assert all(60 <= id < 149 for id in gone)


@pytest.mark.long
@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"points": None}, "points"),
        ({"pixels": np.zeros((3, 3))}, "pixels"),
        ({"intrinsics": np.ones(6)}, "intrinsics"),
        ({"intrinsics": np.full(7, np.nan)}, "nan"),
        ({"T_rectified_left": np.ones(3)}, "T_rectified_left"),
    ],
)
def test_a_damaged_map_is_named_before_it_is_merged(tmp_path: Path, changed: dict[str, np.ndarray | None], said: str):
    points = {name: getattr(PointMap.empty(), name) for name in PointMap.__slots__}
    arrays = {**walked(0.1 * np.arange(3)).pack("learned", CAMERA), **points}
    np.savez_compressed(tmp_path / "map.npz", **arrays)
    assert "keyframes  3 within" in MapFile(tmp_path).describe()
    arrays = {name: value for name, value in {**arrays, **changed}.items() if value is not None}
    np.savez_compressed(tmp_path / "map.npz", **arrays)
    with pytest.raises(InputError, match=said):
        MapFile(tmp_path)


def test_points_of_left_cameras_are_turned_like_their_keyframes(monkeypatch: pytest.MonkeyPatch):
    """Maps of a rig that is rectified by a turn: keyframes are in the world of the rectified camera."""
    turn, T = se3_exp(np.array([0, 0, 0, 0.01, -0.02, 0.3])), se3_exp(np.array([2.0, 0, 1.0, 0, 0.4, 0]))
    point = np.array([[1.0, 2.0, 5.0]])
    points = replace(PointMap.empty(), points=point, covariances=np.zeros((1, 3, 3)))
    points = replace(points, **{name: np.zeros(1) for name in ("observations", "timestamps", "intensity")})
    points = replace(points, pixels=np.zeros((1, 2)))
    key = Keyframe(0, 0.0, view_of(0))
    shared = {"frontend": "learned", "path": Path("map.npz"), "camera": CAMERA, "T_rectified_left": turn}
    shared |= {"keyframes": [key], "hanging": [], "known": [key], "past": ONE_POSE, "pose": lambda keyframe: np.eye(4)}
    one, other = (SimpleNamespace(points=each, **shared) for each in (PointMap.empty(), points))
    monkeypatch.setattr(map_merging, "read_keyframes", lambda *arguments: None)
    monkeypatch.setattr(map_merging, "_find", lambda *maps: (key, map_merging.Link(0, T, np.zeros((6, 6)), 99)))
    merged = map_merging.merge(one, other)
    seen = transform_points(se3_inverse(turn) @ T @ turn, point)
    np.testing.assert_allclose(merged["points"], seen, atol=1e-12)
    np.testing.assert_array_equal(merged["T_rectified_left"], turn)


@pytest.mark.long
def test_a_run_that_remembers_less_than_its_map_forgets_it_in_order(tmp_path: Path):
    """Of thirty keyframes none hangs; those of the map that do are handed on until they are forgotten."""
    np.savez_compressed(tmp_path / "map.npz", **walked(0.1 * np.arange(120), 240).pack("learned", CAMERA))
    keyframes = walked(0.1 * np.arange(60), 30, tmp_path / "map.npz", first=200)
    known = keyframes.left_long_ago()
    assert {each.origin for each in known} <= {each.id for each in keyframes.remembered}
    assert len(keyframes.appearance) == len(known)


@pytest.mark.long
def test_maps_of_several_runs_grow(tmp_path: Path):
    """A run in the map of a run in the map of a run: all of their keyframes are known, where they were."""
    path, places = tmp_path / "map.npz", 0.1 * np.arange(50)
    for run in range(3):
        keyframes = walked(5.0 * run + places, path=path if run else None, first=100 * run)
        np.savez_compressed(path, **keyframes.pack("learned", CAMERA))
    again = Keyframes(make_window(np.zeros(3), camera=CAMERA), 2400, 100)
    again.load(path, "learned", CAMERA)
    known = again.left_long_ago()
    np.testing.assert_allclose(np.sort(again.poses(known)[:, 0, 3]), 0.1 * np.arange(150), atol=1e-6)
    (best,) = retrieve(jittered(view_of(103), np.random.default_rng(0)), 1, known, again.appearance)
    np.testing.assert_allclose(again.poses([best])[0], looking(5.3), atol=1e-6)


def test_a_map_without_descriptors_says_that_it_is_weak(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    bare = keyframe(0, 40)
    features = replace(bare.view.features, descriptors=np.zeros((40, 0), np.float32))
    past = PastPoses(looking(0.0)[None], np.eye(6), np.zeros((6, CALIBRATION_SIZE)), np.zeros((6, CALIBRATION_SIZE)))
    arrays = pack_keyframes([replace(bare, view=replace(bare.view, features=features))], past, "klt", CAMERA)
    np.savez_compressed(tmp_path / "map.npz", **arrays)
    read_keyframes(tmp_path, "klt", CAMERA)  # or the folder
    assert "maps of the front-end klt have no descriptors" in caplog.text


def test_no_keyframes_pack_to_no_arrays():
    assert pack_keyframes([], PastPoses.empty(), "learned", CAMERA) == {}


def refused(path: Path, *words: str, frontend: str = "learned", camera: RectifiedStereo = CAMERA) -> None:
    """One message that names the file and says these words."""
    with pytest.raises(InputError) as caught:
        read_keyframes(path, frontend, camera)
    for word in (str(path), *words):
        assert word in str(caught.value)


def test_a_missing_map_is_refused(tmp_path: Path):
    refused(tmp_path / "nowhere.npz", "no such file")


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_a_truncated_map_is_refused(tmp_path: Path, share: float):
    path = tmp_path / "map.npz"
    np.savez_compressed(path, **pack_keyframes([keyframe(0)], ONE_POSE, "learned", CAMERA))
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    refused(path, "is no numpy archive", "track the sequence again")


def test_a_map_that_is_no_archive_is_refused(tmp_path: Path):
    path = tmp_path / "map.npz"
    path.write_text("x y z\n")
    refused(path, "is no numpy archive", "track the sequence again")


def test_a_map_without_keyframes_is_refused(tmp_path: Path):
    path = tmp_path / "map.npz"
    np.savez_compressed(path, points=np.zeros((3, 3)))
    refused(path, "without keyframes", "make it by a run")


def test_a_map_of_another_front_end_is_refused(tmp_path: Path):
    path = tmp_path / "map.npz"
    np.savez_compressed(path, **pack_keyframes([keyframe(0)], ONE_POSE, "sift", CAMERA))
    refused(path, "front-end sift, not learned", "--frontend sift")


def test_a_map_of_another_camera_is_refused(tmp_path: Path):
    path = tmp_path / "map.npz"
    np.savez_compressed(path, **pack_keyframes([keyframe(0)], ONE_POSE, "learned", CAMERA))
    refused(path, "0.1", "0.2", "a map serves the camera that made it", camera=replace(CAMERA, baseline=0.2))


def changed(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[dict], dict]:
    return lambda arrays: arrays | {f"keyframe_{name}": change(arrays[f"keyframe_{name}"])}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (changed("covariance", lambda a: a[:5]), "keyframe_covariance is float64 (5, 12) and must be floating (5, 5)"),
        (changed("covariance", lambda a: a[:6, :6]), "keyframe_covariance is (6, 6) for 2 poses of 6"),
        (changed("covariance", lambda a: -a), "keyframe_covariance is no covariance"),
        (changed("poses", lambda a: a.astype(str)), "keyframe_poses is <U32 (2, 4, 4) and must be floating"),
        (changed("poses", lambda a: a * np.nan), "keyframe_poses has a value that is not finite"),
        (changed("poses", lambda a: 2 * a), "keyframe_poses are not rigid"),
        (changed("counts", lambda a: a + 1), "keyframe_counts are not of the 42 keypoints"),
        (changed("counts", lambda a: a * [-1, 1]), "keyframe_counts are not of the 42 keypoints"),
        (changed("image_bytes", lambda a: a + 1), "keyframe_image_bytes are not of the"),
        (changed("origins", lambda a: a[::-1]), "keyframe_origins are not the first 2 keyframes"),
        (changed("origins", lambda a: a * 1.0), "keyframe_origins is float64"),
        (changed("descriptors", lambda a: a.astype(np.int16)), "keyframe_descriptors are int16, not int8"),
        (changed("images", lambda a: a.astype(np.uint16)), "keyframe_images are uint16, not uint8"),
        (changed("counts", lambda a: a * 1.0), "keyframe_counts is float64"),
        (changed("keypoints", lambda a: a[1:]), "keyframe_descriptors is int8 (42, 64) and must be"),
        (changed("images", lambda a: a[::-1]), "keyframe_images are not all images of the camera's size"),
        (changed("sigma", lambda a: a + np.inf), "keyframe_sigma has a value that is not finite"),
        (lambda arrays: arrays | {"intrinsics": np.zeros(3)}, "intrinsics is float64 (3,) and must be floating (7)"),
        (lambda arrays: arrays | {"intrinsics": np.full(7, np.nan)}, "a map serves the camera that made it"),
    ],
)
def test_a_map_whose_arrays_do_not_go_together_is_refused(tmp_path: Path, change: Callable[[dict], dict], words: str):
    none = np.zeros((12, CALIBRATION_SIZE))
    past = PastPoses(np.stack([looking(0.0), looking(1.0)]), np.eye(12), none, none)
    arrays = pack_keyframes([keyframe(0, 40), keyframe(1, 17)], past, "learned", CAMERA)
    np.savez_compressed(tmp_path / "map.npz", **change(arrays))
    refused(tmp_path / "map.npz", words)


def test_an_array_in_place_of_a_map_is_refused_without_advice_to_unpickle(tmp_path: Path):
    np.save(tmp_path / "map.npy", np.eye(4))
    (tmp_path / "map.npy").rename(tmp_path / "map.npz")
    refused(tmp_path / "map.npz", "is a single array (.npy) and no archive")
    (tmp_path / "map.npz").write_text("x y z\n")
    with pytest.raises(InputError) as caught:
        read_keyframes(tmp_path / "map.npz", "learned", CAMERA)
    assert "pickle" not in str(caught.value)


# ---- what the motion excludes


@pytest.mark.parametrize(
    ("away", "inliers", "is_measured", "is_found"),
    [
        (0.01, 20, False, True),
        (5.0, 20, False, False),
        (5.0, 60, False, True),
        (5.0, 60, True, False),
        (0.01, 60, True, True),
    ],
)
def test_no_place_is_found_that_the_motion_excludes(away: float, inliers: int, is_measured: bool, is_found: bool):
    relocaliser = relocaliser_where(range(2), 0.1 + away, inliers, is_measured)
    assert (relocaliser.relocalise(view_of(0, 80), after_gap=True) is not None) == is_found
    # Who goes on from there empties it.
    assert len(relocaliser.window) == 1


@pytest.mark.parametrize(("away", "inliers", "is_found"), [(0.01, 60, True), (0.01, 20, False), (5.0, 60, False)])
def test_a_view_is_found_in_the_last_keyframe_where_motion_and_many_features_agree(
    away: float, inliers: int, is_found: bool
):
    relocaliser = relocaliser_where([1], away, inliers)
    assert relocaliser.relocalise(view_of(0, 80), after_gap=False) is None
    found = relocaliser.relocalise(view_of(0, 80), after_gap=True)
    assert (found is not None) == is_found
    if found is not None:
        assert found.keyframe is relocaliser.keyframes.active[0]
        np.testing.assert_allclose(found.pose, looking(0.1 + away), atol=1e-12)


def relocaliser_where(seen: Iterable[int], x: float, inliers: int, is_measured: bool = False) -> Relocaliser:
    """After a keyframe at 0 that left the window and one at 0.1 that did not; views are x beside those that are seen.

    The motion expects no step, to 0.1.
    """
    keyframes = visited([looking(0.0)], 10)
    window = keyframes._window
    window.add_keyframe(looking(0.1), looking(0.1), 1e-4 * np.eye(6), NO_WALK, 1.0)
    keyframes.append(view_of(1, 80), 0.5)
    motion = SimpleNamespace(
        step=np.eye(4),
        step_covariance=1e-2 * np.eye(6),
        is_inertial=is_measured,
        is_odometric=False,
        reckoning="inertial",
    )
    relative = RelativePose(looking(x), np.arange(80) < inliers, 1e-4 * np.eye(6), 1.0)
    known = [
        view for number, view in enumerate((keyframes.remembered[0].view, keyframes.active[0].view)) if number in seen
    ]
    matcher = SimpleNamespace(
        confirmed_pose_to=lambda key, view: relative if any(key is each for each in known) else None,
        is_beyond_chance=lambda found: inliers > 45,
    )
    return Relocaliser(window, keyframes, motion, matcher, AdmitAll(10, 12.0), 15)


# ---- the tracker


@pytest.fixture(scope="module")
def demo_run(demo_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of the whole demo, with tracks."""
    out = tmp_path_factory.mktemp("demo") / "run"
    track(demo_sequence, out, tracks=True)
    return out


@pytest.mark.slow
def test_a_lost_tracker_finds_its_way_back_to_remembered_keyframes(demo: Demo):
    """Tracked, moved to another world so long that the window holds nothing else, black, and back at the start."""
    camera, frames, truth = demo
    tracker = StereoTracker(camera, config=TrackerConfig(window=2, keyframe_ratio=0.8))
    black = np.zeros_like(frames[0].left)
    for frame in frames[:21]:
        tracker.step(frame.left, frame.right, frame.timestamp)
    for k, frame in enumerate(frames[8:20]):
        other = mirrored(frame, 6.0 + 0.05 * k)
        tracker.step(other.left, other.right, other.timestamp)
    for k in range(4):
        assert tracker.step(black, black, 6.6 + 0.05 * k).status == "lost"
    back = [tracker.step(frame.left, frame.right, 6.8 + 0.05 * k) for k, frame in enumerate(frames[:8])]
    assert [each.status for each in back] == ["relocalised"] + ["tracking"] * 7
    assert max(squared_error(each, truth[k]) for k, each in enumerate(back)) < WITHIN_3_SIGMA
    assert max(np.linalg.norm(error_of(each, truth[k])[:3]) for k, each in enumerate(back)) < 0.01


@pytest.mark.slow
def test_black_frames_and_a_jump_back_are_survived(demo: Demo):
    """Early frames again after a second of nothing: found by what the window still knows, or by the memory."""
    camera, frames, truth = demo
    tracker = StereoTracker(camera)
    black = np.zeros_like(frames[0].left)
    for frame in frames[:35]:
        tracker.step(frame.left, frame.right, frame.timestamp)
    lost = [tracker.step(black, black, 1.75 + 0.05 * k) for k in range(20)]
    assert {each.status for each in lost} == {"lost"}
    back = [tracker.step(frame.left, frame.right, 2.75 + 0.05 * k) for k, frame in enumerate(frames[:8])]
    # Frames after the jump do not move on as the jump did: they may be of another time, for all one knows.
    assert {each.doubts for each in back if each.status == "doubtful"} <= {(Doubt.TIME,)}
    assert {each.status for each in back} <= {"relocalised", "tracking", "doubtful", "lost"}
    assert all(each.status == "tracking" for each in back[-3:])
    for k, each in enumerate(back):
        assert each.status == "lost" or squared_error(each, truth[k]) < WITHIN_3_SIGMA


@pytest.mark.long
def test_poses_are_in_the_world_of_the_map(demo: Demo, demo_run: Path):
    """Beginning in mid-run, where the map knows the place from elsewhere."""
    camera, frames, truth = demo
    tracker = StereoTracker(camera)
    tracker.load_map(demo_run / "map.npz")
    for k in range(10, 16):
        estimate = tracker.step(frames[k].left, frames[k].right, frames[k].timestamp)
        assert estimate.status == ("relocalised" if k == 10 else "tracking")
        # By the keyframe that it was found by it is no loop, too.
        assert k > 10 or estimate.loop is None
        assert np.linalg.norm(error_of(estimate, truth[k])[:3]) < 0.01
        assert squared_error(estimate, truth[k]) < WITHIN_3_SIGMA
    final, covariances = tracker.final_trajectory()
    errors = se3_log(se3_inverse(final.poses) @ truth[10:16])
    assert np.linalg.norm(errors[:, :3], axis=1).max() < 0.01
    assert squared_sigmas(errors, covariances).max() < WITHIN_3_SIGMA


def test_a_tracker_takes_one_map_and_no_later_one(demo: Demo, demo_run: Path):
    """Keyframes of two would have the same numbers."""
    camera, frames, _ = demo
    for before in ("map", "frame"):
        tracker = StereoTracker(camera)
        if before == "map":
            tracker.load_map(demo_run / "map.npz")
        else:
            tracker.step(frames[0].left, frames[0].right, frames[0].timestamp)
        with pytest.raises(InputError, match="takes one map"):
            tracker.load_map(demo_run / "map.npz")


def test_results_may_be_taken_while_another_thread_steps(demo: Demo):
    camera, frames, _ = demo
    tracker, taken, ended = StereoTracker(camera, threads=1), [], Event()

    def take():
        while not ended.wait(0.01):
            final, covariances = tracker.final_trajectory()
            taken.append(len(final) == len(covariances))
            tracker.map()
            tracker.pack_keyframes()

    with ThreadPoolExecutor(1) as pool:
        reading = pool.submit(take)
        try:
            for frame in frames[:12]:
                tracker.step(frame.left, frame.right, frame.timestamp)
        finally:
            ended.set()
        reading.result()
    assert taken
    assert all(taken)


@pytest.mark.long
@pytest.mark.parametrize("again", ["the place", "black"])
def test_a_late_right_eye_finds_its_way_back_by_two_views(demo: Demo, again: str):
    """One that is found alone leaves everything as it was."""
    (camera, frames, _), delay = demo, 0.01
    frames = delay_right(1e3 * delay, frames, np.random.default_rng(0))
    tracker = StereoTracker(camera, config=TrackerConfig(window=2, keyframe_ratio=0.8), right_delay=delay)
    black = np.zeros_like(frames[0].left)
    for frame in [*frames[:21], *(mirrored(each, 6.0 + 0.05 * k) for k, each in enumerate(frames[8:20]))]:
        tracker.step(frame.left, frame.right, frame.timestamp)
    pairs = [(black, black)] * 4 + [(each.left, each.right) for each in frames[:6]]
    if again == "black":
        pairs[5:] = [(black, black)] * 4
    found = [tracker.step(*pair, 6.6 + 0.05 * k).status for k, pair in enumerate(pairs)]
    assert found[:5] == ["lost"] * 5
    assert found[5:] == (["relocalised", *["tracking"] * 4] if again == "the place" else ["lost"] * 4)


@pytest.mark.long
def test_a_late_right_eye_finds_its_place_in_a_map(demo: Demo, demo_run: Path):
    """Disparities of a view are wrong by a velocity that two views show, once both are found."""
    (camera, frames, truth), delay = demo, 0.04
    tracker = StereoTracker(camera, right_delay=delay)
    tracker.load_map(demo_run / "map.npz")
    late = delay_right(1e3 * delay, frames, np.random.default_rng(0))[10:18]
    estimates = [tracker.step(each.left, each.right, each.timestamp) for each in late]
    assert [each.status for each in estimates] == ["starting", "relocalised", *["tracking"] * 6]
    for estimate, true in zip(estimates[1:], truth[11:18], strict=True):
        assert squared_error(estimate, true) < WITHIN_3_SIGMA


@pytest.mark.slow
def test_a_run_in_its_own_map_stays_in_its_world(demo_sequence: Path, demo_run: Path, tmp_path: Path):
    summary = track(demo_sequence, tmp_path / "run", map=demo_run / "map.npz")
    assert (summary["starting"], summary["relocalised"], summary["tracking"]) == (0, 1, 39)
    truth = read_kitti(demo_sequence / "poses.txt").poses
    found = read_kitti(tmp_path / "run" / "trajectory.kitti").poses
    assert np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.01
    assert not (tmp_path / "run" / "tracks.npz").exists()  # nobody asked for it


@pytest.mark.long
def test_a_view_that_is_nowhere_in_the_map_has_no_pose(demo: Demo, demo_run: Path):
    camera, frames, _ = demo
    tracker = StereoTracker(camera)
    tracker.load_map(demo_run / "map.npz")
    for k in range(4):
        frame = mirrored(frames[k], 0.05 * k)
        estimate = tracker.step(frame.left, frame.right, frame.timestamp)
        assert estimate.status == "starting"
        assert_no_pose(estimate)
    estimate = tracker.step(frames[5].left, frames[5].right, 0.3)
    assert estimate.status == "relocalised"
    final, covariances = tracker.final_trajectory()
    assert final.timestamps.tolist() == [0.3]
    assert covariances.shape == (1, 6, 6)
    np.testing.assert_allclose(final.poses[0], estimate.T_world_camera, atol=1e-9)
    np.testing.assert_allclose(covariances[0], estimate.covariance, atol=1e-9)


@pytest.mark.long
def test_tracks_begin_with_their_hosts_and_are_read_by_refine(demo_run: Path):
    with np.load(demo_run / "tracks.npz") as archive:
        tracks = {name: archive[name] for name in archive.files}
    count = len(tracks["frame"])
    assert count > 500
    assert tracks["frame"].shape == tracks["landmark"].shape == (count,)
    assert tracks["measurement"].shape == (count, 3)
    assert tracks["covariance"].shape == (count, 3, 3)
    assert tracks["intrinsics"].shape == (5,)
    assert tracks["R_rectified_left"].shape == (3, 3)
    assert tracks["disparity_offset"].shape == (2,)
    # Rows ascend with time, so the first of a landmark is its host, which has it in stereo.
    assert (np.diff(tracks["frame"]) >= 0).all()
    landmarks, first = np.unique(tracks["landmark"], return_index=True)
    assert np.isfinite(tracks["measurement"][first]).all()
    # Nothing is seen twice in one keyframe, and a good part is seen again in a later one.
    pairs = np.column_stack([tracks["frame"], tracks["landmark"]])
    assert len(np.unique(pairs, axis=0)) == count
    assert count - len(landmarks) > 100
    read = read_tracks(demo_run / "tracks.npz", 40)
    np.testing.assert_array_equal(read.landmark, tracks["landmark"])
    np.testing.assert_array_equal(read.measurement, tracks["measurement"])
