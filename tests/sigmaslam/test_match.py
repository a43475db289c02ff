"""Matching of two images: on a known warp, plain and refined, by the command, and what it says to bad input."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest

import sigmaslam
from sigmaslam import Matches, session
from sigmaslam.errors import InputError
from sigmaslam.frontend.classical import SiftDetector
from sigmaslam.frontend.types import Features
from sigmaslam.match import draw_matches, match_features, refine_matches
from sigmaslam.synthetic.textures import dead_leaves

FIELDS = ("keypoints0", "keypoints1", "probability", "covariance")
SHAPES_OF_NONE = [(0, 2), (0, 2), (0,), (0, 2, 2)]
# Turns by 12 degrees, enlarges by a tenth and shifts.
WARP = np.array([[1.076, -0.2287, 40.0], [0.2287, 1.076, -60.0]])


@pytest.fixture(scope="module")
def pair() -> tuple[np.ndarray, np.ndarray]:
    """A textured image and the same through `WARP`, of another size, darker and noisier."""
    image0 = dead_leaves((360, 480), np.random.default_rng(3))
    warped = cv2.warpAffine(image0, WARP, (500, 380), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
    noise = np.random.default_rng(4).normal(0.0, 2.0, warped.shape)
    return image0, np.clip(np.round(0.8 * warped + noise), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module", params=["sift", "orb", "learned"])
def frontend(request: pytest.FixtureRequest) -> str:
    if request.param == "learned":
        path = session.shipped_weights("features.onnx")
        if not path.is_file():
            pytest.skip("features.onnx is not in models/weights")
        if "count" not in [entry.name for entry in onnxruntime.InferenceSession(path).get_inputs()]:
            pytest.skip("the shipped features.onnx is of the old kind: it has no input 'count'")
    return str(request.param)


@pytest.fixture(scope="module")
def nearest(frontend: str, pair: tuple[np.ndarray, np.ndarray]) -> Matches:
    """The mutual nearest neighbours."""
    return sigmaslam.match_images(*pair, frontend=frontend, max_keypoints=600, refine=False)


@pytest.fixture(scope="module")
def matches(frontend: str, pair: tuple[np.ndarray, np.ndarray]) -> Matches:
    """As the command gives them: consistent and aligned."""
    return sigmaslam.match_images(*pair, frontend=frontend, max_keypoints=600)


@pytest.fixture(params=[False, True], ids=["nearest", "refined"])
def either(request: pytest.FixtureRequest, nearest: Matches, matches: Matches) -> Matches:
    return matches if request.param else nearest


def errors(matches: Matches) -> np.ndarray:
    """(M, 2) of keypoints1 against the true place of keypoints0."""
    return np.asarray(matches.keypoints1 - (matches.keypoints0 @ WARP[:, :2].T + WARP[:, 2]))


def empty() -> Matches:
    return Matches(*(np.zeros(shape, np.float32) for shape in SHAPES_OF_NONE))


def write(path: Path, image: np.ndarray) -> Path:
    cv2.imwrite(str(path), image)
    return path


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "sigmaslam", "match", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


# What is found


def test_the_most_probable_neighbours_are_right(nearest: Matches):
    distance = np.linalg.norm(errors(nearest), axis=1)
    assert len(distance) > 100
    # ORB's coarse octaves have pixels of up to 3.6, which its covariance says.
    limit = np.maximum(2.0, 3.0 * np.sqrt(nearest.covariance[:, 0, 0]))
    assert (distance < limit)[: len(distance) // 4].mean() > 0.9


def test_the_more_probable_half_of_the_neighbours_is_more_precise(nearest: Matches):
    right = np.linalg.norm(errors(nearest), axis=1) < 3.0
    half = len(right) // 2
    assert right[:half].mean() >= right[half:].mean()


def test_probabilities_are_sorted_and_matches_one_to_one(either: Matches):
    assert ((either.probability > 0) & (either.probability <= 1)).all()
    assert (np.diff(either.probability) <= 0).all()
    for keypoints in (either.keypoints0, either.keypoints1):
        assert len(np.unique(keypoints, axis=0)) == len(keypoints)


def test_every_field_is_float32_of_its_shape(either: Matches):
    count = len(either.probability)
    shapes = [(count, 2), (count, 2), (count,), (count, 2, 2)]
    for name, shape in zip(FIELDS, shapes, strict=True):
        assert getattr(either, name).dtype == np.float32
        assert getattr(either, name).shape == shape


def test_covariances_are_positive_and_not_too_sure_of_right_matches(either: Matches):
    np.testing.assert_array_equal(either.covariance, either.covariance.transpose(0, 2, 1))
    assert (np.linalg.eigvalsh(either.covariance) > 0).all()
    error = errors(either)
    right = np.linalg.norm(error, axis=1) < 3.0
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(either.covariance), error)
    # 1.39 for a normal law. So clean a warp stays below: sigma of SIFT and ORB is a rule of thumb for photographs.
    assert np.median(squared[right]) < 2.5


def test_probability_is_the_product_of_the_two_softmaxes():
    rng = np.random.default_rng(0)
    features = []
    for count in (30, 40):
        descriptors = rng.standard_normal((count, 8)).astype(np.float32)
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        places = rng.uniform(0, 99, (count, 2)).astype(np.float32)
        features.append(Features(places, descriptors, np.ones(count, np.float32), np.full(count, 0.5, np.float32)))
    found = match_features(*features, inverse_temperature=7.0)
    similarity = features[0].descriptors @ features[1].descriptors.T
    expected = {}
    for i, row in enumerate(similarity):
        j = int(row.argmax())
        if similarity[:, j].argmax() == i:
            forward = np.exp(7.0 * row[j]) / np.exp(7.0 * row).sum()
            backward = np.exp(7.0 * row[j]) / np.exp(7.0 * similarity[:, j]).sum()
            expected[tuple(features[0].keypoints[i])] = forward * backward
    assert len(expected) == len(found.probability) > 5
    wanted = [expected[tuple(place)] for place in found.keypoints0]
    np.testing.assert_allclose(found.probability, wanted, rtol=1e-5)
    np.testing.assert_allclose(found.covariance, np.tile(0.5 * np.eye(2), (len(wanted), 1, 1)))


# What refinement makes of it


def test_refined_matches_are_more_exact_and_more_often_right(nearest: Matches, matches: Matches):
    before, after = (np.linalg.norm(errors(found), axis=1) for found in (nearest, matches))
    assert np.median(after) < np.median(before)
    assert np.median(after) < 0.1
    assert (after < 1.0).mean() > (before < 1.0).mean()
    # Nothing right was lost for it.
    assert (after < 1.0).sum() > 0.98 * (before < 1.0).sum()


def test_refinement_drops_and_moves_and_changes_nothing_else(nearest: Matches, matches: Matches):
    row_of = {tuple(place): row for row, place in enumerate(nearest.keypoints0)}
    rows = np.array([row_of[tuple(place)] for place in matches.keypoints0])
    # In their order.
    assert (np.diff(rows) > 0).all()
    np.testing.assert_array_equal(matches.probability, nearest.probability[rows])
    shift = np.linalg.norm(matches.keypoints1 - nearest.keypoints1[rows], axis=1)
    # Three pixels of the coarser image, of which two are 2 half octaves apart at most here.
    assert shift.max() < 6.0
    expected = np.tile(0.09 * np.eye(2, dtype=np.float32), (len(rows), 1, 1))
    np.testing.assert_allclose(matches.covariance, expected, rtol=1e-6)


def test_matches_whose_patches_do_not_fit_are_dropped(pair: tuple[np.ndarray, np.ndarray], matches: Matches):
    """Half of the second image is repainted: hardly a match is left there."""
    image0, image1 = pair
    repainted = image1.copy()
    repainted[:, : image1.shape[1] // 2] = np.random.default_rng(0).integers(0, 255, repainted.shape, np.uint8)[
        :, : image1.shape[1] // 2
    ]
    left = matches.keypoints1[:, 0] < image1.shape[1] / 2 - 16
    right = matches.keypoints1[:, 0] > image1.shape[1] / 2 + 16
    again = refine_matches(image0, repainted, matches)
    kept = {tuple(place) for place in again.keypoints0}
    survived = np.array([tuple(place) in kept for place in matches.keypoints0])
    assert survived[left].mean() < 0.1
    assert survived[right].mean() > 0.95


def test_without_refinement_every_mutual_nearest_neighbour_is_a_match(pair: tuple[np.ndarray, np.ndarray]):
    features0, features1 = (SiftDetector(600)(image) for image in pair)
    found = sigmaslam.match_images(*pair, "sift", 600, refine=False)
    similarity = features0.descriptors @ features1.descriptors.T
    best = similarity.argmax(axis=1)
    mutual = np.flatnonzero(similarity.argmax(axis=0)[best] == np.arange(len(best)))
    expected = {(*features0.keypoints[i], *features1.keypoints[best[i]]) for i in mutual}
    assert {(*a, *b) for a, b in zip(found.keypoints0, found.keypoints1, strict=True)} == expected


def test_wrong_matches_among_right_ones_are_dropped(pair: tuple[np.ndarray, np.ndarray]):
    rng = np.random.default_rng(6)
    keypoints0 = rng.uniform((120, 80), (400, 300), (400, 2)).astype(np.float32)
    keypoints1 = (keypoints0 @ WARP[:, :2].T + WARP[:, 2]).astype(np.float32)
    wrong = rng.random(400) < 0.3
    keypoints1[wrong] = rng.uniform((20, 20), (480, 360), (int(wrong.sum()), 2))
    probability = np.where(wrong, 0.3, 0.7).astype(np.float32)
    given = Matches(keypoints0, keypoints1, probability, np.tile(np.eye(2, dtype=np.float32), (400, 1, 1)))
    kept = {tuple(place) for place in refine_matches(*pair, given).keypoints0}
    found = np.array([tuple(place) in kept for place in keypoints0])
    assert found[~wrong].mean() > 0.97
    assert found[wrong].mean() < 0.1


@pytest.mark.parametrize("count", [0, 1, 3])
def test_fewer_than_four_matches_cannot_be_refined(pair: tuple[np.ndarray, np.ndarray], count: int):
    """No neighbours say that they are right: none is left."""
    places = np.random.default_rng(0).uniform(100, 300, (count, 2)).astype(np.float32)
    given = Matches(places, places, np.ones(count, np.float32), np.tile(np.eye(2, dtype=np.float32), (count, 1, 1)))
    found = refine_matches(*pair, given)
    assert [getattr(found, name).shape for name in FIELDS] == SHAPES_OF_NONE


def test_refinement_leaves_its_input(nearest: Matches, pair: tuple[np.ndarray, np.ndarray]):
    before = [getattr(nearest, name).copy() for name in FIELDS]
    refine_matches(*pair, nearest)
    for name, copy in zip(FIELDS, before, strict=True):
        np.testing.assert_array_equal(getattr(nearest, name), copy)


# Odd input


@pytest.mark.parametrize("refine", [True, False])
@pytest.mark.parametrize("name", ["sift", "orb"])
def test_a_black_image_has_no_matches(pair: tuple[np.ndarray, np.ndarray], name: str, refine: bool):
    found = sigmaslam.match_images(pair[0], np.zeros((100, 120), np.uint8), name, refine=refine)
    assert [getattr(found, name).shape for name in FIELDS] == SHAPES_OF_NONE


def test_the_picture_shows_both_images_whatever_their_sizes(pair: tuple[np.ndarray, np.ndarray]):
    image0, image1 = pair
    plain = draw_matches(image0, image1, empty())
    np.testing.assert_array_equal(plain[:360, :480], np.repeat(image0[..., None], 3, axis=2))
    np.testing.assert_array_equal(plain[:380, 480:], np.repeat(image1[..., None], 3, axis=2))
    one = Matches(
        np.full((1, 2), 50, np.float32), np.full((1, 2), 60, np.float32), np.ones(1), np.eye(2, dtype=np.float32)[None]
    )
    blue, green, red = draw_matches(image0, image1, one)[52, 150].astype(int)
    assert min(green, red) > blue + 50  # yellow: certain


# The command


@pytest.mark.parametrize("option", [[], ["--refine"], ["--no-refine"]], ids=lambda option: "".join(option) or "default")
def test_the_command_writes_what_the_library_finds(
    pair: tuple[np.ndarray, np.ndarray], tmp_path: Path, option: list[str]
):
    files = [write(tmp_path / name, image) for name, image in zip(("a.png", "b.pgm"), pair, strict=True)]
    out, picture = tmp_path / "matches.npz", tmp_path / "matches.png"
    options = ("--frontend", "sift", "--max-keypoints", "300", "--picture", picture)
    result = run(*files, "--out", out, *options, *option)
    assert result.returncode == 0, result.stderr
    expected = sigmaslam.match_images(*pair, "sift", 300, refine=option != ["--no-refine"])
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


def test_no_matches_are_no_error(tmp_path: Path):
    black = write(tmp_path / "black.png", np.zeros((100, 120), np.uint8))
    result = run(black, black, "--out", tmp_path / "m.npz", "--frontend", "orb", "--picture", tmp_path / "m.png")
    assert result.returncode == 0, result.stderr
    assert "0 and 0 keypoints, no matches" in result.stdout
    with np.load(tmp_path / "m.npz") as archive:
        assert archive["covariance"].shape == (0, 2, 2)


@pytest.mark.parametrize("kind", ["colour", "alpha", "16-bit"])
def test_colours_and_depths_match_as_their_grey_image(pair: tuple[np.ndarray, np.ndarray], tmp_path: Path, kind: str):
    grey = pair[0]
    stored = {
        "colour": cv2.merge([grey] * 3),
        "alpha": cv2.merge([grey] * 3 + [np.full_like(grey, 255)]),
        "16-bit": grey.astype(np.uint16) * 257,
    }[kind]
    files = write(tmp_path / "a.png", grey), write(tmp_path / "b.png", stored)
    result = run(*files, "--out", tmp_path / "m.npz", "--frontend", "sift", "--no-refine")
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    with np.load(tmp_path / "m.npz") as archive:
        assert len(archive["probability"]) > 100
        np.testing.assert_array_equal(archive["keypoints0"], archive["keypoints1"])


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
    result = run("--frontend", "sift", *arguments)
    assert result.returncode == 2, result.stderr
    assert "Traceback" not in result.stderr
    for word in words:
        assert word in result.stderr
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_the_library_refuses_what_it_cannot_match(pair: tuple[np.ndarray, np.ndarray]):
    with pytest.raises(InputError, match=r"image1 is float64 of shape \(380, 500\)"):
        sigmaslam.match_images(pair[0], pair[1].astype(float), "sift")
    with pytest.raises(InputError, match=r"image0 is uint8 of shape \(9, 9, 3\)"):
        sigmaslam.match_images(np.zeros((9, 9, 3), np.uint8), pair[1], "sift")
    with pytest.raises(InputError, match=r"surf.*learned, sift, orb"):
        sigmaslam.match_images(*pair, "surf")


def test_the_help_names_files_and_options():
    result = run("--help")
    assert result.returncode == 0
    for word in (
        "IMAGE0",
        "IMAGE1",
        "--out",
        "--frontend",
        "--max-keypoints",
        "--no-refine",
        "--picture",
        "keypoints0",
    ):
        assert word in result.stdout
