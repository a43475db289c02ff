"""Matching of two images: on a known warp, of any probability, by the command, and what it says to bad input."""

from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest
from scipy.stats import chi2

import sigmaslam
from sigmaslam import Matches
from sigmaslam.errors import InputError
from sigmaslam.frontend.classical import OrbDetector, SiftDetector
from sigmaslam.frontend.image_pair import draw_matches, match_features, match_twice
from sigmaslam.frontend.learned import LearnedDetector
from sigmaslam.frontend.match_confidence import MIN_LOGIT, ConfidenceEstimator
from sigmaslam.frontend.nearest_neighbours import nearest_anywhere
from sigmaslam.frontend.types import Features
from sigmaslam.inference.onnx_graph import shipped_weights
from sigmaslam_synthetic.rendering.textures import dead_leaves
from tests.support.commands import assert_refused, run_here, run_process

FIELDS = ("keypoints0", "keypoints1", "probability", "covariance", "index0", "index1")
SHAPES_OF_NONE = [(0, 2), (0, 2), (0,), (0, 2, 2), (0,), (0,)]
DETECTORS = {"learned": LearnedDetector, "sift": SiftDetector, "orb": OrbDetector}
Pair = tuple[np.ndarray, np.ndarray]
# Turns by 12 degrees, enlarges by a tenth and shifts.
WARP = np.array([[1.076, -0.2287, 40.0], [0.2287, 1.076, -60.0]])


@pytest.fixture(scope="module")
def pair() -> Pair:
    """A textured image and the same through `WARP`, of another size, darker and noisier."""
    image0 = dead_leaves((360, 480), np.random.default_rng(3))
    warped = cv2.warpAffine(image0, WARP, (500, 380), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
    noise = np.random.default_rng(4).normal(0.0, 2.0, warped.shape)
    return image0, np.clip(np.round(0.8 * warped + noise), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module", params=["sift", "orb", "learned"])
def frontend(request: pytest.FixtureRequest) -> str:
    if request.param == "learned":
        path = shipped_weights("features.onnx")
        if not path.is_file():
            pytest.skip("features.onnx is not in models/sigmaslam_weights")
        if "count" not in [entry.name for entry in onnxruntime.InferenceSession(path).get_inputs()]:
            pytest.skip("the shipped features.onnx is of the old kind: it has no input 'count'")
    return str(request.param)


@pytest.fixture(scope="module")
def features(frontend: str, pair: Pair) -> tuple[Features, Features]:
    detect = DETECTORS[frontend](600)
    return detect(pair[0]), detect(pair[1])


@pytest.fixture(scope="module")
def estimator() -> ConfidenceEstimator:
    return ConfidenceEstimator()


@pytest.fixture(scope="module")
def everything(frontend: str, pair: Pair) -> Matches:
    """Matches of any probability."""
    return sigmaslam.match_images(*pair, frontend=frontend, max_keypoints=600, min_probability=0.0)


@pytest.fixture(scope="module")
def matches(frontend: str, pair: Pair) -> Matches:
    """As the command gives them: more likely right than wrong."""
    return sigmaslam.match_images(*pair, frontend=frontend, max_keypoints=600)


@pytest.fixture(params=[False, True], ids=["everything", "probable"])
def either(request: pytest.FixtureRequest, everything: Matches, matches: Matches) -> Matches:
    return matches if request.param else everything


def warped(points: np.ndarray) -> np.ndarray:
    return np.asarray(points @ WARP[:, :2].T + WARP[:, 2])


def errors(matches: Matches) -> np.ndarray:
    """(M, 2) of keypoints1 against the true place of keypoints0."""
    return np.asarray(matches.keypoints1 - warped(matches.keypoints0))


def mutual(features: tuple[Features, Features]) -> list[tuple[int, int]]:
    """Mutual nearest neighbours without equals, in order of image 0."""
    similarity = features[0].descriptors @ features[1].descriptors.T
    best = [similarity == similarity.max(axis=axis, keepdims=True, initial=-1.0) for axis in (0, 1)]
    alone = [each & (each.sum(axis=axis, keepdims=True) == 1) for axis, each in enumerate(best)]
    rows, columns = np.nonzero(alone[0] & alone[1])
    return list(zip(rows.tolist(), columns.tolist(), strict=True))


def pairs(matches: Matches) -> list[tuple[int, int]]:
    return list(zip(matches.index0.tolist(), matches.index1.tolist(), strict=True))


def empty() -> Matches:
    return Matches(*(np.zeros(shape, np.float32) for shape in SHAPES_OF_NONE))


def write(path: Path, image: np.ndarray) -> Path:
    cv2.imwrite(str(path), image)
    return path


# What is found


def test_the_most_probable_matches_are_right(everything: Matches):
    distance = np.linalg.norm(errors(everything), axis=1)
    assert len(distance) > 100
    assert (distance < 2.0)[: len(distance) // 4].mean() > 0.9


def test_the_more_probable_half_of_the_matches_is_more_often_right(everything: Matches):
    right = np.linalg.norm(errors(everything), axis=1) < 3.0
    half = len(right) // 2
    assert right[:half].mean() >= right[half:].mean()


def test_probabilities_are_sorted_and_matches_one_to_one(either: Matches):
    assert ((either.probability > 0) & (either.probability <= 1)).all()
    assert (np.diff(either.probability) <= 0).all()
    for index in (either.index0, either.index1):
        assert len(np.unique(index)) == len(index)
    for keypoints in (either.keypoints0, either.keypoints1):
        assert len(np.unique(keypoints, axis=0)) == len(keypoints)


def test_every_field_is_of_its_type_and_shape(either: Matches):
    count = len(either.probability)
    shapes = [(count, 2), (count, 2), (count,), (count, 2, 2), (count,), (count,)]
    types = [np.float32] * 4 + [np.int64] * 2
    for name, shape, kind in zip(FIELDS, shapes, types, strict=True):
        assert getattr(either, name).dtype == kind
        assert getattr(either, name).shape == shape


def test_covariances_are_positive_and_not_too_sure_of_right_matches(either: Matches):
    # Symmetric but for the rounding of float32.
    asymmetry = np.abs(either.covariance[:, 0, 1] - either.covariance[:, 1, 0])
    assert (asymmetry <= 1e-6 * np.trace(either.covariance, axis1=1, axis2=2)).all()
    assert (np.linalg.eigvalsh(either.covariance) > 0).all()
    error = errors(either)
    right = np.linalg.norm(error, axis=1) < 3.0
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(either.covariance), error)
    # 1.39 for a normal law.
    assert np.median(squared[right]) < 2.5


def test_of_any_probability_all_mutual_neighbours_are_matches_but_hopeless_ones(
    estimator: ConfidenceEstimator, pair: Pair, features: tuple[Features, Features]
):
    everything = match_features(estimator, *pair, *features, min_probability=0.0)
    found, expected = set(pairs(everything)), set(mutual(features))
    assert found <= expected
    putative = nearest_anywhere(features[0].descriptors, features[1].descriptors)
    hopeless = estimator.score(putative, *features) <= MIN_LOGIT
    index = zip(putative.index0[hopeless].tolist(), putative.index1[hopeless].tolist(), strict=True)
    assert expected - found == expected & set(index)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_of_a_least_probability_the_matches_are_the_first_of_all(
    estimator: ConfidenceEstimator, pair: Pair, features: tuple[Features, Features], everything: Matches, share: float
):
    least = float(np.quantile(everything.probability, share))
    found = match_twice(estimator, *pair, *features, min_probability=least)
    expected = everything.select(everything.probability >= least)
    assert 0 < len(found.probability) < len(everything.probability)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


# What refinement makes of it


def test_matches_are_more_exact_and_more_often_right_than_mutual_neighbours(
    features: tuple[Features, Features], matches: Matches
):
    index0, index1 = np.array(mutual(features)).T
    before = np.linalg.norm(features[1].keypoints[index1] - warped(features[0].keypoints[index0]), axis=1)
    after = np.linalg.norm(errors(matches), axis=1)
    assert np.median(after) < np.median(before)
    assert np.median(after) < 0.1
    assert (after < 1.0).mean() > (before < 1.0).mean()
    # Nothing right was lost for it.
    assert (after < 1.0).sum() > 0.98 * (before < 1.0).sum()


def test_refinement_moves_places_a_little_and_changes_nothing_else(
    features: tuple[Features, Features], either: Matches
):
    np.testing.assert_array_equal(either.keypoints0, features[0].keypoints[either.index0])
    shift = np.linalg.norm(either.keypoints1 - features[1].keypoints[either.index1], axis=1)
    # Three pixels of the coarser image, of which two are 2 half octaves apart at most here.
    assert shift.max() < 6.0


def test_matches_whose_patches_do_not_fit_are_less_probable_and_less_exact(
    estimator: ConfidenceEstimator, pair: Pair, features: tuple[Features, Features]
):
    """Half of the second image is repainted, the features stay where they are, which is right to a few pixels."""
    image0, image1 = pair
    everything = match_features(estimator, *pair, *features, min_probability=0.0)
    middle = image1.shape[1] // 2
    repainted = image1.copy()
    repainted[:, :middle] = np.random.default_rng(0).integers(0, 255, repainted.shape, np.uint8)[:, :middle]
    found = match_features(estimator, image0, repainted, *features, min_probability=0.0)
    row_of = {each: row for row, each in enumerate(pairs(found))}
    again = found.select(np.array([row_of[each] for each in pairs(everything)]))
    u = features[1].keypoints[everything.index1, 0]
    probable = everything.probability > 0.5
    left, right = probable & (u < middle - 16), probable & (u > middle + 16)
    area, area_again = (np.linalg.det(each.covariance[left]) for each in (everything, again))
    assert (again.probability < everything.probability)[left].mean() > 0.95
    assert (area_again > area).mean() > 0.95
    assert np.median(area_again / area) > 100.0
    np.testing.assert_array_equal(again.probability[right], everything.probability[right])
    np.testing.assert_array_equal(again.covariance[right], everything.covariance[right])


def alike(keypoints0: np.ndarray, keypoints1: np.ndarray) -> tuple[Features, Features]:
    """Features (N, 2) and (N, 2) of which number i is like number i alone, noise apart."""
    rng = np.random.default_rng(7)
    count = len(keypoints0)
    descriptors = rng.standard_normal((count, 64)) + 0.2 * rng.standard_normal((2, count, 64))
    descriptors /= np.linalg.norm(descriptors, axis=2, keepdims=True)
    first, second = (
        Features(
            points.astype(np.float32),
            values.astype(np.float32),
            np.linspace(1.0, 0.5, count, dtype=np.float32),
            np.full(count, 0.5, np.float32),
        )
        for points, values in zip((keypoints0, keypoints1), descriptors, strict=True)
    )
    return first, second


def test_wrong_matches_among_right_ones_are_dropped(estimator: ConfidenceEstimator, pair: Pair):
    rng = np.random.default_rng(6)
    keypoints0 = rng.uniform((120, 80), (400, 300), (400, 2))
    keypoints1 = warped(keypoints0)
    wrong = rng.random(400) < 0.3
    keypoints1[wrong] = rng.uniform((20, 20), (480, 360), (int(wrong.sum()), 2))
    found = np.isin(np.arange(400), match_features(estimator, *pair, *alike(keypoints0, keypoints1)).index0)
    assert found[~wrong].mean() > 0.97
    assert found[wrong].mean() < 0.1


def test_the_second_round_finds_what_looks_like_a_place_far_from_its_epipolar_line(
    estimator: ConfidenceEstimator, pair: Pair
):
    """Of every fifth point image 1 has a twin, anywhere, which is a little more like the point of image 0."""
    rng = np.random.default_rng(8)
    keypoints0 = rng.uniform((120, 80), (400, 300), (400, 2))
    features0, features1 = alike(keypoints0, warped(keypoints0))
    doubled = np.arange(0, 400, 5)
    twins = Features(
        rng.uniform((20, 20), (480, 360), (len(doubled), 2)).astype(np.float32),
        features0.descriptors[doubled],
        features1.scores[doubled],
        features1.sigma[doubled],
    )
    features1 = Features.concatenate([features1, twins])
    once, twice = (match(estimator, *pair, features0, features1) for match in (match_features, match_twice))
    right = [np.isin(doubled, each.index0[each.index0 == each.index1]).mean() for each in (once, twice)]
    assert right[0] == 0.0
    # An affine map leaves the lines uncertain, so that a twin may lie near one.
    assert right[1] > 0.8
    # Who had a match has it still.
    assert set(pairs(once)) - set(pairs(twice)) == set()
    distance = np.linalg.norm(errors(twice), axis=1)
    assert (distance < 3.0).mean() > 0.98


def test_without_a_geometry_there_is_one_round(
    estimator: ConfidenceEstimator, pair: Pair, features: tuple[Features, Features]
):
    few = [each.select(np.arange(15)) for each in features]
    once, twice = (match(estimator, *pair, *few, 0.0) for match in (match_features, match_twice))
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(twice, name), getattr(once, name))


@pytest.mark.parametrize("count", [0, 1, 3])
def test_fewer_than_four_matches_stay_where_they_are(estimator: ConfidenceEstimator, pair: Pair, count: int):
    """No neighbours say how their patches are turned."""
    places = np.random.default_rng(0).uniform(150, 300, (count, 2))
    features = alike(places, warped(places) + 0.5)
    found = match_features(estimator, *pair, *features, min_probability=0.0)
    assert [getattr(found, name).shape[1:] for name in FIELDS] == [shape[1:] for shape in SHAPES_OF_NONE]
    assert set(pairs(found)) <= set(mutual(features))
    np.testing.assert_array_equal(found.keypoints1, features[1].keypoints[found.index1])


def test_matching_leaves_its_input(estimator: ConfidenceEstimator, pair: Pair, features: tuple[Features, Features]):
    given = [*pair, *(getattr(each, name) for each in features for name in ("keypoints", "descriptors", "sigma"))]
    before = [array.copy() for array in given]
    match_features(estimator, *pair, *features)
    for array, copy in zip(given, before, strict=True):
        np.testing.assert_array_equal(array, copy)


# Odd input


@pytest.mark.parametrize("least", [0.0, 0.5])
@pytest.mark.parametrize("name", ["sift", "orb"])
def test_a_black_image_has_no_matches(pair: Pair, name: str, least: float):
    found = sigmaslam.match_images(pair[0], np.zeros((100, 120), np.uint8), name, min_probability=least)
    assert [getattr(found, name).shape for name in FIELDS] == SHAPES_OF_NONE


def test_the_picture_shows_both_images_whatever_their_sizes(pair: Pair):
    image0, image1 = pair
    plain = draw_matches(image0, image1, empty())
    np.testing.assert_array_equal(plain[:360, :480], np.repeat(image0[..., None], 3, axis=2))
    np.testing.assert_array_equal(plain[:380, 480:], np.repeat(image1[..., None], 3, axis=2))
    places = np.full((1, 2), 50, np.float32), np.full((1, 2), 60, np.float32)
    index = np.zeros(1, np.int64)
    one = Matches(*places, np.ones(1), np.eye(2, dtype=np.float32)[None], index, index)
    blue, green, red = draw_matches(image0, image1, one)[52, 150].astype(int)
    assert min(green, red) > blue + 50  # yellow: certain


# The command


@pytest.mark.long
@pytest.mark.parametrize(("option", "least"), [([], 0.5), (["--min-probability", "0"], 0.0)], ids=["default", "any"])
def test_the_command_writes_what_the_library_finds(pair: Pair, tmp_path: Path, option: list[str], least: float):
    files = [write(tmp_path / name, image) for name, image in zip(("a.png", "b.pgm"), pair, strict=True)]
    out, picture = tmp_path / "matches.npz", tmp_path / "matches.png"
    options = ("--frontend", "sift", "--max-keypoints", "300", "--picture", picture)
    result = run_process("images", "match", *files, "--out", out, *options, *option)
    assert result.returncode == 0, result.stderr
    expected = sigmaslam.match_images(*pair, "sift", 300, least)
    with np.load(out) as archive:
        assert sorted(archive.files) == sorted(FIELDS)
        for name in FIELDS:
            np.testing.assert_array_equal(archive[name], getattr(expected, name))
    assert len(result.stdout.splitlines()) == 1
    assert f"{len(expected.probability)} matches" in result.stdout
    image = cv2.imread(str(picture))
    assert image is not None
    assert image.shape == (380, 980, 3)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "b.pgm", "matches.npz", "matches.png"]


@pytest.mark.long
def test_no_matches_are_no_error(tmp_path: Path):
    black = write(tmp_path / "black.png", np.zeros((100, 120), np.uint8))
    result = run_process(
        "match", black, black, "--out", tmp_path / "m.npz", "--frontend", "orb", "--picture", tmp_path / "m.png"
    )
    assert result.returncode == 0, result.stderr
    assert "0 and 0 keypoints, no matches" in result.stdout
    with np.load(tmp_path / "m.npz") as archive:
        assert archive["covariance"].shape == (0, 2, 2)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["colour", "alpha", "16-bit"])
def test_colours_and_depths_match_as_their_grey_image(pair: Pair, tmp_path: Path, kind: str):
    grey = pair[0]
    stored = {
        "colour": cv2.merge([grey] * 3),
        "alpha": cv2.merge([grey] * 3 + [np.full_like(grey, 255)]),
        "16-bit": grey.astype(np.uint16) * 257,
    }[kind]
    files = write(tmp_path / "a.png", grey), write(tmp_path / "b.png", stored)
    result = run_process(
        "images", "match", *files, "--out", tmp_path / "m.npz", "--frontend", "sift", "--min-probability", "0"
    )
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    expected = sigmaslam.match_images(grey, grey, "sift", min_probability=0.0)
    with np.load(tmp_path / "m.npz") as archive:
        assert len(archive["probability"]) > 100
        np.testing.assert_array_equal(archive["index0"], archive["index1"])
        for name in FIELDS:
            np.testing.assert_array_equal(archive[name], getattr(expected, name))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["missing.png", "b.png", "--out", "m.npz"], ["missing.png", "missing"]),
        (["a.png", "text.png", "--out", "m.npz"], ["text.png", "not an image"]),
        (["a.png", ".", "--out", "m.npz"], ["directory"]),
        (["a.png", "float.tiff", "--out", "m.npz"], ["float.tiff", "float32"]),
        (["a.png", "small.png", "--out", "m.npz"], ["small.png", "200x95", "96"]),
        (["a.png", "b.png", "--out", "m.txt"], ["--out", "m.txt", ".npz"]),
        (["a.png", "b.png", "--out", "nowhere/m.npz"], ["nowhere", "create it"]),
        (["a.png", "b.png", "--out", "m.npz", "--picture", "nowhere/m.png"], ["nowhere", "create it"]),
        (["a.png", "b.png", "--out", "m.npz", "--picture", "m.jpg"], ["--picture", "m.jpg", ".png"]),
        (["a.png", "b.png", "--out", "m.npz", "--picture", "b.png"], ["--picture", "b.png", "overwrite"]),
        (["a.png", "b.png", "--out", "m.npz", "--max-keypoints", "3"], ["--max-keypoints", "3", "at least 4"]),
        (["a.png", "b.png", "--out", "m.npz", "--min-probability", "1.1"], ["--min-probability", "less"]),
        (["a.png", "b.png", "--out", "m.npz", "--frontend", "klt"], ["klt", "learned", "sift", "orb"]),
    ],
    ids=lambda value: " ".join(value[-2:]),
)
def test_bad_input_is_refused_with_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], words: list[str]
):
    monkeypatch.chdir(tmp_path)
    for name, shape in (("a.png", (100, 120)), ("b.png", (100, 120)), ("small.png", (95, 200))):
        write(tmp_path / name, np.full(shape, 90, np.uint8))
    write(tmp_path / "float.tiff", np.full((100, 120), 0.5, np.float32))
    (tmp_path / "text.png").write_text("no image at all")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    result = run_here("images", "match", "--frontend", "sift", *arguments)
    assert_refused(result, *words)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_the_library_refuses_what_it_cannot_match(pair: Pair):
    with pytest.raises(InputError, match=r"image1 is float64 of shape \(380, 500\)"):
        sigmaslam.match_images(pair[0], pair[1].astype(float), "sift")
    with pytest.raises(InputError, match=r"image0 is uint8 of shape \(9, 9, 3\)"):
        sigmaslam.match_images(np.zeros((9, 9, 3), np.uint8), pair[1], "sift")
    with pytest.raises(InputError, match=r"surf.*learned, sift, orb"):
        sigmaslam.match_images(*pair, "surf")
    for least in (-0.1, 1.1, np.nan):
        with pytest.raises(InputError, match=rf"--min-probability is {least}"):
            sigmaslam.match_images(*pair, "sift", min_probability=least)


def test_the_help_names_files_and_options():
    result = run_here("images", "match", "--help")
    assert result.returncode == 0
    for word in (
        "IMAGE0",
        "IMAGE1",
        "--out",
        "--frontend",
        "--max-keypoints",
        "--min-probability",
        "--picture",
        "keypoints0",
    ):
        assert word in result.stdout


# Large images


def large_pair(long_side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Leaves of that long side, the same turned and shifted, and the map (2, 3) between them."""
    shape = (long_side * 3 // 4, long_side)
    base = dead_leaves((360, 480), np.random.default_rng(5))
    image0 = cv2.resize(base, shape[::-1], interpolation=cv2.INTER_CUBIC)
    H = cv2.getRotationMatrix2D((0.5 * shape[1], 0.5 * shape[0]), 6.0, 1.05)
    return image0, cv2.warpAffine(image0, H, shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), H


@pytest.mark.long
def test_matches_of_large_images_are_in_their_own_pixels():
    image0, image1, H = large_pair(2400)
    matches = sigmaslam.match_images(image0, image1, max_keypoints=400)
    offset = matches.keypoints1 - (matches.keypoints0 @ H[:, :2].T + H[:, 2])
    assert len(offset) > 100
    assert matches.keypoints0.max() > 1700
    assert np.median(np.abs(offset)) < 0.5
    # A shift of half a pixel, of shrinking by corners, would show here.
    assert np.abs(np.median(offset, axis=0)).max() < 0.2
    squared = np.einsum("mi,mij,mj->m", offset, np.linalg.inv(matches.covariance), offset)
    assert np.median(squared) < chi2.ppf(0.5, 2)  # on renders sigma is too large rather than too small


@pytest.mark.long
def test_a_large_image_is_matched_as_the_same_shrunk():
    """Against shrinking by hand: what the small pair gives, in larger pixels."""
    image0, image1, _ = large_pair(3200)
    small = [cv2.resize(image, (1600, 1200), interpolation=cv2.INTER_AREA) for image in (image0, image1)]
    expected = sigmaslam.match_images(*small, max_keypoints=300)
    found = sigmaslam.match_images(image0, image1, max_keypoints=300)
    np.testing.assert_array_equal(found.probability, expected.probability)
    np.testing.assert_allclose(found.keypoints0, 2.0 * expected.keypoints0 + 0.5, atol=1e-3)
    np.testing.assert_allclose(found.keypoints1, 2.0 * expected.keypoints1 + 0.5, atol=1e-3)
    np.testing.assert_allclose(found.covariance, 4.0 * expected.covariance, rtol=1e-6)


@pytest.mark.long
def test_a_pair_of_two_sizes_shrinks_the_large_one_alone():
    image0, image1, H = large_pair(2400)
    small1 = cv2.resize(image1, (960, 720), interpolation=cv2.INTER_AREA)
    matches = sigmaslam.match_images(image0, small1, max_keypoints=400)
    places = (matches.keypoints0 @ H[:, :2].T + H[:, 2] + 0.5) * 0.4 - 0.5
    assert len(places) > 100
    assert (np.linalg.norm(matches.keypoints1 - places, axis=1) < 1.0).mean() > 0.9


def test_a_strip_keeps_enough_pixels_to_be_matched():
    strip = cv2.resize(dead_leaves((100, 500), np.random.default_rng(1)), (2500, 100))
    matches = sigmaslam.match_images(strip, strip, max_keypoints=100)
    np.testing.assert_allclose(matches.keypoints1, matches.keypoints0, atol=0.5)
