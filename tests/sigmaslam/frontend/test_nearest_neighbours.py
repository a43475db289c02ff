import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.frontend import FRONTENDS, Frontend, StereoView, build_frontend, patch_kernels
from sigmaslam.frontend.classical import OrbDetector, SiftDetector
from sigmaslam.frontend.learned import LearnedDetector
from sigmaslam.frontend.lucas_kanade import lucas_kanade, refine
from sigmaslam.frontend.nearest_neighbours import Putative, nearest_anywhere, nearest_in_ellipses
from sigmaslam.frontend.types import KeypointSearch
from sigmaslam.inference import onnx_graph as session
from sigmaslam.readers import open_sequence
from sigmaslam_synthetic.simulation import Simulation, Studio
from sigmaslam_training.matching.match_sets import nearest_in_rows

# Of two degrees of freedom, whose distribution is exponential.
CHI_SQUARE_99 = -2.0 * np.log(0.01)


def unit(rng: np.random.Generator, *shape: int) -> np.ndarray:
    values = rng.standard_normal(shape)
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


def brute_force(d0: np.ndarray, d1: np.ndarray, allowed: np.ndarray, ratio: float) -> list[tuple[int, int]]:
    """Mutual nearest neighbours among allowed pairs whose runner-up is clearly further, as loops over distances."""
    pairs = []
    for i in range(len(d0)):
        candidates = sorted((np.linalg.norm(d0[i] - d1[j]), j) for j in range(len(d1)) if allowed[i, j])
        if not candidates:
            continue
        distance, j = candidates[0]
        rivals = [np.linalg.norm(d0[k] - d1[j]) for k in range(len(d0)) if allowed[k, j]]
        if distance > min(rivals):
            continue
        if len(candidates) == 1 or distance <= ratio * candidates[1][0]:
            pairs.append((i, j))
    return pairs


def all_nearest(d0: np.ndarray, d1: np.ndarray, allowed: np.ndarray) -> list[tuple[int, int, float, float, float]]:
    """The fields of `Putative`, mutual or not, as loops over similarities."""
    rows = []
    for i in range(len(d0)):
        candidates = sorted(((d0[i] @ d1[j], j) for j in range(len(d1)) if allowed[i, j]), reverse=True)
        if candidates:
            similarity, j = candidates[0]
            second0 = candidates[1][0] if len(candidates) > 1 else -1.0
            second1 = max((d0[k] @ d1[j] for k in range(len(d0)) if k != i and allowed[k, j]), default=-1.0)
            rows.append((i, j, similarity, second0, second1))
    return rows


def ellipses(radius: np.ndarray) -> np.ndarray:
    """Covariances (N, 2, 2) whose 99 % ellipses are circles of these radii (N,), pixels."""
    return radius[:, None, None] ** 2 / CHI_SQUARE_99 * np.eye(2)


# Matching


@dataclass(frozen=True, slots=True)
class Search:
    """What was found among descriptors where only some pairs are allowed.

    Attributes:
        found: by the function under test.
        d0, d1: (80, 6), (90, 6) of unit length.
        allowed: (80, 90) bool.
    """

    found: Putative
    d0: np.ndarray
    d1: np.ndarray
    allowed: np.ndarray


def in_rows(tolerance: float) -> Search:
    rng = np.random.default_rng(0)
    left, right = rng.uniform(0, 60, (80, 2)), rng.uniform(0, 60, (90, 2))
    d0, d1 = unit(rng, 80, 6), unit(rng, 90, 6)
    disparity = left[:, None, 0] - right[None, :, 0]
    allowed = np.abs(left[:, None, 1] - right[None, :, 1]) <= tolerance
    allowed &= (disparity >= -2.0) & (disparity <= 30.0)
    return Search(nearest_in_rows(left, right, d0, d1, tolerance, (-2.0, 30.0)), d0, d1, allowed)


def in_ellipses(largest: float) -> Search:
    """Of standard deviations from 1 px to `largest`, turned any way."""
    rng = np.random.default_rng(1)
    predicted, keypoints = rng.uniform(0, 60, (80, 2)), rng.uniform(0, 60, (90, 2))
    axes = np.linalg.qr(rng.standard_normal((80, 2, 2)))[0]
    covariance = (axes * rng.uniform(1, largest, (80, 1, 2)) ** 2) @ axes.transpose(0, 2, 1)
    d0, d1 = unit(rng, 80, 6), unit(rng, 90, 6)
    offset = keypoints[None] - predicted[:, None]
    allowed = np.einsum("nmi,nij,nmj->nm", offset, np.linalg.inv(covariance), offset) <= CHI_SQUARE_99
    return Search(nearest_in_ellipses(predicted, covariance, keypoints, d0, d1), d0, d1, allowed)


def anywhere() -> Search:
    rng = np.random.default_rng(2)
    d0, d1 = unit(rng, 80, 6), unit(rng, 90, 6)
    return Search(nearest_anywhere(d0, d1), d0, d1, np.ones((80, 90), bool))


# Few allowed pairs and many are compared in different ways.
SEARCHES = {
    "narrow band": lambda: in_rows(4.0),
    "wide band": lambda: in_rows(15.0),
    "small ellipses": lambda: in_ellipses(5.0),
    "large ellipses": lambda: in_ellipses(25.0),
    "anywhere": anywhere,
}


@pytest.fixture(params=SEARCHES.values(), ids=SEARCHES)
def search(request: pytest.FixtureRequest) -> Search:
    return request.param()


@pytest.mark.parametrize("ratio", [0.7, 0.9, 0.99])
def test_mutual_and_distinct_matches_equal_brute_force(search: Search, ratio: float):
    found = search.found.select(search.found.mutual & search.found.distinct(ratio))
    expected = brute_force(search.d0, search.d1, search.allowed, ratio)
    assert list(zip(found.index0.tolist(), found.index1.tolist(), strict=True)) == expected
    assert len(expected) > 5


def test_neighbours_and_all_runners_up_equal_brute_force(search: Search):
    found = search.found
    expected = np.array(all_nearest(search.d0, search.d1, search.allowed))
    np.testing.assert_array_equal(np.column_stack([found.index0, found.index1]), expected[:, :2])
    np.testing.assert_allclose(np.column_stack([found.similarity, found.second0, found.second1]), expected[:, 2:])
    assert not found.mutual.all()


def test_matches_are_one_to_one_and_respect_the_geometry():
    rng = np.random.default_rng(2)
    left, right = rng.uniform(0, 100, (200, 2)), rng.uniform(0, 100, (200, 2))
    found = nearest_in_rows(left, right, unit(rng, 200, 8), unit(rng, 200, 8), 2.0, (0.0, 40.0))
    assert len(set(found.index0)) == len(found.index0)
    mutual = found.select(found.mutual)
    assert len(set(mutual.index0)) == len(mutual.index0) == len(set(mutual.index1)) > 20
    disparity = left[found.index0, 0] - right[found.index1, 0]
    assert np.abs(left[found.index0, 1] - right[found.index1, 1]).max() <= 2.0
    assert disparity.min() >= 0.0
    assert disparity.max() <= 40.0


def at_one_place(d0: np.ndarray, d1: np.ndarray) -> list[Putative]:
    """By each way of search, all keypoints at (0, 0)."""
    place0, place1 = np.zeros((len(d0), 2)), np.zeros((len(d1), 2))
    return [
        nearest_anywhere(d0, d1),
        nearest_in_rows(place0, place1, d0, d1, 2.0, (0.0, 10.0)),
        nearest_in_ellipses(place0, ellipses(np.full(len(d0), 5.0)), place1, d0, d1),
    ]


def test_shuffled_copies_find_each_other():
    rng = np.random.default_rng(3)
    descriptors, order = unit(rng, 50, 32), rng.permutation(50)
    for found in at_one_place(descriptors, descriptors[order]):
        assert (found.mutual & found.distinct(0.9)).all()
        np.testing.assert_array_equal(found.index0, np.arange(50))
        np.testing.assert_array_equal(order[found.index1], found.index0)


def test_two_equal_candidates_are_no_match():
    """Neither for the one keypoint of image 0 nor for the one of image 1, in any number type."""
    one = unit(np.random.default_rng(4), 1, 16)
    for kind in (np.float32, np.float64):
        d = one.astype(kind)
        for found in at_one_place(d, np.repeat(d, 2, axis=0)):
            assert len(found.index0) == 1
            assert not found.mutual.any()
            assert not found.distinct(0.95).any()
        for found in at_one_place(np.repeat(d, 2, axis=0), d):
            assert len(found.index0) == 2
            assert not found.mutual.any()


def test_a_candidate_without_rivals_is_mutual_and_distinct():
    d0, d1 = unit(np.random.default_rng(4), 2, 1, 16)
    for found in at_one_place(d0, d1):
        assert found.second0 == found.second1 == -1.0
        assert found.mutual.all()
        assert found.distinct(0.99).all()


@pytest.mark.parametrize(("count0", "count1"), [(0, 5), (5, 0), (0, 0)])
def test_nothing_matches_nothing(count0, count1):
    rng = np.random.default_rng(5)
    for found in at_one_place(unit(rng, count0, 4), unit(rng, count1, 4)):
        assert len(found.index0) == len(found.index1) == len(found.mutual) == len(found.distinct(0.9)) == 0


def test_what_is_far_away_matches_nothing():
    rng = np.random.default_rng(5)
    near, far, d0, d1 = rng.uniform(0, 50, (5, 2)), rng.uniform(80, 90, (5, 2)), unit(rng, 5, 4), unit(rng, 5, 4)
    assert len(nearest_in_rows(near, far, d0, d1, 2.0, (0.0, 10.0)).index0) == 0
    assert len(nearest_in_ellipses(near, ellipses(np.full(5, 9.0)), far, d0, d1).index0) == 0


# Refinement


def shifted_texture(shift: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """A smooth texture and the same moved by a Fourier shift, which no interpolation blurs."""
    noise = np.random.default_rng(6).standard_normal((128, 128))
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0, borderType=cv2.BORDER_REFLECT)
    spectrum = np.fft.fft2(smooth)
    v, u = np.meshgrid(np.fft.fftfreq(128), np.fft.fftfreq(128), indexing="ij")
    moved = np.fft.ifft2(spectrum * np.exp(-2j * np.pi * (u * shift[0] + v * shift[1]))).real
    low, high = smooth.min(), smooth.max()
    return tuple(np.round(np.clip((x - low) / (high - low), 0, 1) * 255).astype(np.uint8) for x in (smooth, moved))


GRID = np.stack(np.meshgrid(np.arange(24.0, 104, 8), np.arange(24.0, 104, 8)), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, -0.4), (-0.75, 0.5), (1.2, 0.9)])
def test_refinement_recovers_a_subpixel_shift(shift):
    first, second = shifted_texture(shift)
    found = refine(first, second, GRID, GRID)
    assert found.moved.mean() > 0.95
    np.testing.assert_array_equal(found.start, GRID)
    error = np.linalg.norm((found.places - GRID - shift)[found.moved], axis=1)
    assert np.median(error) < 0.02
    assert np.quantile(error, 0.95) < 0.05


def test_a_point_that_would_go_too_far_stays():
    first, second = shifted_texture((3.5, 0.0))
    found = refine(first, second, GRID, GRID, reach=2.0)
    np.testing.assert_array_equal(found.places[~found.moved], GRID[~found.moved])
    assert np.linalg.norm(found.places - GRID, axis=1).max() <= 2.0
    assert found.moved.mean() < 0.2


def test_refinement_of_no_points_is_no_points():
    image = np.zeros((32, 32), np.uint8)
    places, found = lucas_kanade(image, image, np.zeros((0, 2)), np.zeros((0, 2)), 11, 2)
    assert places.shape == (0, 2)
    assert found.shape == (0,)
    refinement = refine(image, image, np.zeros((0, 2)), np.zeros((0, 2)))
    assert refinement.start.shape == refinement.places.shape == (0, 2)
    assert refinement.moved.shape == (0,)


# Front-ends on the shipped demo, whose exact depth the renderer knows


def frontend(name: str) -> Frontend:
    if name == "learned" and not session.shipped_weights("features.onnx").is_file():
        pytest.skip("features.onnx is not in models/sigmaslam_weights")
    return build_frontend(name, 600)


@pytest.fixture(scope="module")
def demo(demo_sequence: Path) -> dict[str, np.ndarray]:
    """Frames 0 and 4 with the true inverse depth of the left views, and the motion between them."""
    simulation = Simulation.from_json(json.loads((demo_sequence / "scene.json").read_text())["simulation"])
    frames = [frame for frame in open_sequence(demo_sequence).frames() if frame.index in (0, 4)]
    poses = simulation.path.poses(np.array([0, 4]) / simulation.fps)
    studio, camera = Studio(simulation), simulation.rig.left
    depths = [studio.renderer.render(studio.left, T[None], np.zeros(1)).depth[0].numpy() for T in poses]
    return {
        "images": np.array([(frame.left, frame.right) for frame in frames]),
        "disparity": camera.fx * simulation.rig.calibrated.baseline / np.array(depths),
        "K": camera.matrix,
        "depth": np.array(depths),
        "T_4_0": np.linalg.inv(poses[1]) @ poses[0],
    }


def at(values: np.ndarray, points: np.ndarray) -> np.ndarray:
    u, v = np.round(points).astype(int).T
    return np.asarray(values[v, u])


@pytest.mark.long
@pytest.mark.parametrize("name", FRONTENDS)
def test_disparity_of_the_demo_is_within_a_pixel_of_the_truth(demo, name):
    view = frontend(name).observe(*demo["images"][0])
    assert view.disparity.shape == (len(view.features.keypoints),)
    known = np.isfinite(view.disparity)
    np.testing.assert_array_equal(np.isfinite(view.disparity_sigma), known)
    assert (view.disparity_sigma[known] > 0).all()
    assert known.sum() > 80
    error = np.abs(view.disparity - at(demo["disparity"][0], view.features.keypoints))[known]
    assert (error < 1.0).mean() > 0.9
    assert np.median(error) < 0.2


@pytest.mark.parametrize("name", FRONTENDS)
def test_matches_of_the_demo_follow_the_true_motion(demo, name):
    """Every match lies within two pixels of where the exact depth and motion put it, or nearly every one."""
    method = frontend(name)
    key, view = (method.observe(*images) for images in demo["images"])
    index = np.flatnonzero(np.isfinite(key.disparity))
    points = key.features.keypoints[index].astype(float)
    rays = np.c_[points, np.ones(len(points))] @ np.linalg.inv(demo["K"]).T
    seen = rays * at(demo["depth"][0], points)[:, None] @ demo["T_4_0"][:3, :3].T + demo["T_4_0"][:3, 3]
    truth = (seen / seen[:, 2:] @ demo["K"].T)[:, :2]
    predicted = truth + np.random.default_rng(0).normal(0, 2.0, truth.shape)
    found = method.match(KeypointSearch(key, index, predicted, ellipses(np.full(len(index), 12.0))), view)
    assert len(np.unique(found.key_index)) == len(found.key_index) > 50
    assert set(found.key_index) <= set(index)
    asymmetry = np.abs(found.covariance[:, 0, 1] - found.covariance[:, 1, 0])
    assert (asymmetry <= 1e-6 * np.trace(found.covariance, axis1=1, axis2=2)).all()
    assert (np.linalg.eigvalsh(found.covariance) > 0).all()
    assert ((found.probability >= 0.5) & (found.probability <= 1)).all()
    np.testing.assert_array_equal(np.isfinite(found.disparity_sigma), np.isfinite(found.disparity))
    row = np.searchsorted(index, found.key_index)
    # Refinement may leave the ellipse by its reach.
    assert np.linalg.norm(found.points - predicted[row], axis=1).max() <= 14.0
    error = np.linalg.norm(found.points - truth[row], axis=1)
    assert (error < 2.0).mean() > 0.85  # its striped wall repeats itself
    assert np.median(error) < 0.4


@pytest.mark.parametrize("name", ["learned", "sift", "orb"])
def test_without_a_covariance_the_prediction_does_not_matter(demo, name):
    method = frontend(name)
    key, view = (method.observe(*images) for images in demo["images"])
    index = np.flatnonzero(np.isfinite(key.disparity))
    somewhere = np.random.default_rng(0).uniform(0, 320, (len(index), 2))
    found, again = (method.match(KeypointSearch(key, index, places), view) for places in (somewhere, somewhere[::-1]))
    assert len(found.key_index) > 50
    np.testing.assert_array_equal(found.key_index, again.key_index)
    np.testing.assert_array_equal(found.points, again.points)


@pytest.mark.parametrize("name", FRONTENDS)
def test_a_black_image_has_no_features(name):
    black = np.zeros((120, 160), np.uint8)
    method = frontend(name)
    view = method.observe(black, black)
    assert len(view.features.keypoints) == len(view.disparity) == len(view.disparity_sigma) == 0
    for covariance in (np.zeros((0, 2, 2)), None):
        nothing = method.match(KeypointSearch(view, np.zeros(0, np.int64), np.zeros((0, 2)), covariance), view)
        assert nothing.points.shape == (0, 2)
        assert nothing.covariance.shape == (0, 2, 2)


@pytest.mark.parametrize("name", FRONTENDS)
def test_a_textured_keyframe_finds_nothing_in_a_black_view(demo, name):
    method = frontend(name)
    key, black = method.observe(*demo["images"][0]), np.zeros((240, 320), np.uint8)
    empty: StereoView = method.observe(black, black)
    index = np.arange(min(20, len(key.disparity)))
    for covariance in (ellipses(np.full(len(index), 20.0)), None):
        found = method.match(KeypointSearch(key, index, key.features.keypoints[index], covariance), empty)
        assert len(found.points) == 0


@pytest.mark.parametrize("detector", [SiftDetector, OrbDetector])
def test_classical_features_are_unit_descriptors_best_first_at_distinct_places(demo, detector):
    features = detector(300)(demo["images"][0, 0])
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, atol=1e-3)
    assert (np.diff(features.scores) <= 0).all()
    assert len(np.unique(features.keypoints, axis=0)) == len(features.keypoints)


@pytest.mark.parametrize("shape", [(240, 320), (101, 131)])
def test_learned_features_lie_in_the_image_whatever_its_size(demo, shape):
    frontend("learned")
    image = demo["images"][0, 0][: shape[0], : shape[1]]
    features = LearnedDetector(200)(image)
    assert 20 < len(features.keypoints) <= 200
    assert (features.keypoints >= 0).all()
    assert (features.keypoints < (shape[1] - 7, shape[0] - 7)).all()


def test_learned_features_are_the_same_without_a_compiler(demo, monkeypatch: pytest.MonkeyPatch):
    frontend("learned")
    pytest.importorskip("sigmaslam.frontend._kernels", reason="installed without a compiler")
    detect, image = LearnedDetector(600), demo["images"][0, 0]
    fast = detect(image)
    monkeypatch.setattr(patch_kernels, "_kernels", None)
    slow = detect(image)
    assert len(fast.keypoints) == len(slow.keypoints)
    distance = np.linalg.norm(fast.keypoints[:, None] - slow.keypoints[None], axis=2)
    near, same = distance.argmin(axis=1), distance.min(axis=1) < 1e-3
    assert same.mean() > 0.995  # round-off decides which of two of nearly equal score is the last
    np.testing.assert_allclose(fast.scores[same], slow.scores[near[same]], atol=1e-5)
    np.testing.assert_allclose(fast.descriptors[same], slow.descriptors[near[same]], atol=1e-4)


def test_an_unknown_front_end_is_refused_with_the_known_ones():
    with pytest.raises(InputError, match=r"surf.*learned, sift, orb, klt"):
        build_frontend("surf", 100)
