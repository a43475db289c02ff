"""The page of ablations on made-up scores, and the extractors that it compares on a random network."""

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor
from torch.nn import functional

from sigmaslam.errors import InputError
from sigmaslam.evaluation.benchmarks import ablations, extraction
from sigmaslam.evaluation.benchmarks.ablations import VARIANTS, Variant, configuration, selection_score, write_ablations
from sigmaslam.evaluation.benchmarks.extraction import EXTRACTIONS
from sigmaslam.evaluation.matching.run import Scores
from sigmaslam.evaluation.matching.sets import SELECTION
from sigmaslam.models.detector import BORDER, find_peaks, to_cells
from sigmaslam.models.extractor import FeatureExtractor
from sigmaslam.models.network import FeatureNetwork
from sigmaslam.synthetic.rendering.textures import dead_leaves
from sigmaslam.training import loop
from sigmaslam.training.loop import WEIGHTS_NAME

COUNT = 200
STEPS = 10
COMMAND = "make the page"


# The page


@dataclasses.dataclass
class Calls:
    """What was trained and scored in place of the real thing.

    Attributes:
        trained: names of the folders, in order, with their configurations.
        scored: folder and extraction, in order.
        sets: those that were asked for.
        resumed: folders that were gone on with.
    """

    trained: dict[str, object] = dataclasses.field(default_factory=dict)
    scored: list[tuple[str, str]] = dataclasses.field(default_factory=list)
    sets: set[str] = dataclasses.field(default_factory=set)
    resumed: list[str] = dataclasses.field(default_factory=list)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    """Training writes an empty file; scores rise by 1 % a seed and are 10 % better with Shi-Tomasi corners."""
    calls = Calls()

    def train(out: Path, config: object, workers: int = 1, resume: bool = False) -> None:
        assert workers == 0
        assert out.name not in calls.trained
        calls.trained[out.name] = config
        if resume:
            calls.resumed.append(out.name)
        out.mkdir(parents=True, exist_ok=True)
        (out / WEIGHTS_NAME).touch()

    def made_up(extractor: tuple[str, str], sets: tuple[str, ...], data: Path) -> Scores:
        assert data == Path("data")
        run, extraction_name = extractor
        calls.scored.append(extractor)
        calls.sets |= set(sets)
        level = 0.3 + 0.01 * int(run.split("-")[-1]) + 0.1 * (extraction_name == "shi_tomasi")
        return {name: dict.fromkeys(ablations._SHOWN[name], level) for name in sets}

    monkeypatch.setattr(loop, "train", train)
    monkeypatch.setattr(ablations, "score", made_up)
    monkeypatch.setattr(ablations, "_extractor", lambda run, variant: (run.name, variant.extraction))
    return calls


def write(folder: Path, seeds: int = 2) -> str:
    return write_ablations(folder / "page.md", folder / "runs", Path("data"), seeds, STEPS, COMMAND)


def rows(page: str) -> dict[str, list[str]]:
    """Cells of the rows by name of the variant."""
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if line[:2] == "| "]
    return {cells[1]: cells for cells in lines[1:]}


def test_the_page_has_a_row_for_each_variant_with_mean_and_deviation(tmp_path: Path, calls: Calls):
    page = write(tmp_path)
    assert f"`{COMMAND}`:" in page
    assert f"{STEPS} steps of 8 pairs at 192x192 a run, 2 seeds" in page
    found = rows(page)
    assert list(found) == [variant.name for variant in VARIANTS]
    columns = sum(len(keys) for keys in ablations._SHOWN.values())
    assert found["default"] == ["", "default", *["30.5 ± 0.7"] * (1 + columns)]
    assert found["Shi-Tomasi corners"] == ["detector", "Shi-Tomasi corners", *["40.5 ± 0.7"] * (1 + columns)]
    assert (tmp_path / "page.md").read_text(encoding="utf-8") == page


def test_one_seed_has_no_deviation(tmp_path: Path, calls: Calls):
    assert rows(write(tmp_path, seeds=1))["default"][2:] == ["30.0"] * (len(rows(write(tmp_path, 1))["default"]) - 2)


def test_only_the_sets_for_selection_are_touched(tmp_path: Path, calls: Calls):
    page = write(tmp_path)
    assert calls.sets == set(SELECTION)
    assert set(ablations._SHOWN) == set(SELECTION)
    assert f"over {' and '.join(SELECTION)}." in page


def test_runs_of_the_same_training_share_their_weights(tmp_path: Path, calls: Calls):
    write(tmp_path)
    trainings = {tuple(variant.training.items()) for variant in VARIANTS}
    assert len(calls.trained) == 2 * len(trainings) < 2 * len(VARIANTS)
    # Every variant is scored all the same, once a seed.
    assert len(calls.scored) == len(set(calls.scored)) == 2 * len(VARIANTS)
    # One seed of all first.
    seeds = [name.split("-")[-1] for name in calls.trained]
    assert seeds == sorted(seeds)


def test_scores_are_kept_beside_the_weights_by_extraction_and_not_computed_again(tmp_path: Path, calls: Calls):
    page = write(tmp_path)
    run = tmp_path / "runs" / f"default-{STEPS}-0"
    extractions = {variant.extraction for variant in VARIANTS if not variant.training}
    assert {path.name for path in run.iterdir()} == {WEIGHTS_NAME, *(f"scores-{name}.json" for name in extractions)}
    assert selection_score(json.loads((run / "scores-default.json").read_text())) == pytest.approx(0.3)
    assert selection_score(json.loads((run / "scores-shi_tomasi.json").read_text())) == pytest.approx(0.4)
    (tmp_path / "runs" / f"default-{STEPS}-1" / "scores-saddles.json").unlink()
    trained, scored = len(calls.trained), len(calls.scored)
    assert write(tmp_path) == page
    assert len(calls.trained) == trained
    assert calls.scored[scored:] == [(f"default-{STEPS}-1", "saddles")]


def test_a_run_that_was_stopped_goes_on(tmp_path: Path, calls: Calls):
    from sigmaslam.training.checkpoint import CHECKPOINT_NAME

    stopped = tmp_path / "runs" / f"stride_8-{STEPS}-0"
    write(tmp_path, seeds=1)
    (stopped / WEIGHTS_NAME).unlink()
    (stopped / CHECKPOINT_NAME).touch()
    calls.trained.clear()
    write(tmp_path, seeds=1)
    assert calls.resumed == [stopped.name]


def test_runs_of_another_network_are_refused(tmp_path: Path, calls: Calls):
    write(tmp_path, seeds=1)
    made_with = tmp_path / "runs" / "made_with.json"
    content = json.loads(made_with.read_text())
    content["network"]["judge.weight"] = [3, 64, 1, 1]
    for bad in (json.dumps(content), None):
        made_with.unlink()
        if bad is not None:
            made_with.write_text(bad)
        with pytest.raises(InputError, match="another --runs"):
            write(tmp_path, seeds=1)


def test_notes_below_the_mark_are_kept(tmp_path: Path, calls: Calls):
    write(tmp_path)
    path = tmp_path / "page.md"
    path.write_text(path.read_text(encoding="utf-8") + "<!-- notes -->\nWe take corners.\n", encoding="utf-8")
    assert write(tmp_path).endswith("<!-- notes -->\nWe take corners.\n")


def test_choices_are_the_mean_over_the_sets_for_selection():
    scores = {name: {"mma_1": 0.2 + place, "mma_3": 0.6 + place, "auc_3": 99.0} for place, name in enumerate(SELECTION)}
    assert selection_score(scores) == pytest.approx(0.9)


def test_every_variant_can_be_trained_and_extracted():
    assert [variant for variant in VARIANTS if not variant.training and variant.extraction == "default"] == [
        VARIANTS[0]
    ]
    assert len({variant.name for variant in VARIANTS if variant.question == "stride"}) == 2
    default = configuration(VARIANTS[0], 3, STEPS)
    assert (default.steps, default.seed, default.validate_every) == (STEPS, 3, 0)
    for variant in VARIANTS:
        assert variant.extraction in EXTRACTIONS
        assert configuration(variant, 3, STEPS) == dataclasses.replace(default, **variant.training)
        # Otherwise the runs would be those of another variant.
        assert all(getattr(default, key) != value for key, value in variant.training.items())


def test_every_extraction_is_used():
    assert {variant.extraction for variant in VARIANTS} == set(EXTRACTIONS)


@pytest.mark.parametrize("training", [{}, {"descriptor_size": 32}, {"stride": 16}], ids=str)
def test_the_weights_of_a_variant_are_read_as_they_were_trained(tmp_path: Path, training: dict[str, int]):
    torch.manual_seed(0)
    state = FeatureNetwork(**training).state_dict()
    save_file({name: value.contiguous() for name, value in state.items()}, tmp_path / WEIGHTS_NAME)
    extract = ablations._extractor(tmp_path, Variant("", "", training, "one_scale"))
    keypoints, descriptors = extract(dead_leaves((128, 160), np.random.default_rng(0)))
    assert len(keypoints) == len(descriptors) > 50
    assert descriptors.shape[1] == training.get("descriptor_size", FeatureNetwork().descriptor_size)


# The extractors


@pytest.fixture(scope="module")
def network() -> FeatureNetwork:
    torch.manual_seed(0)
    return FeatureNetwork().eval()


@pytest.fixture(scope="module")
def image() -> Tensor:
    texture = dead_leaves((192, 256), np.random.default_rng(3)).astype(np.float32)
    noisy = texture + np.random.default_rng(4).normal(0.0, 2.0, texture.shape)
    return torch.from_numpy(np.clip(noisy, 0, 255).astype(np.float32) / 255.0)[None, None]


def extracted(name: str, network: FeatureNetwork, image: Tensor, count: int = COUNT) -> tuple[Tensor, ...]:
    with torch.inference_mode():
        found: tuple[Tensor, ...] = EXTRACTIONS[name](network).eval()(image, torch.tensor(count))
    return found


@pytest.mark.parametrize("name", EXTRACTIONS)
def test_every_extraction_gives_unit_descriptors_of_places_in_the_image(
    name: str, network: FeatureNetwork, image: Tensor
):
    keypoints, scores, descriptors, sigma = extracted(name, network, image)
    count = len(keypoints)
    assert 0.97 * COUNT < count <= COUNT
    assert [array.shape for array in (keypoints, scores, descriptors, sigma)] == [
        (count, 2),
        (count,),
        (count, network.descriptor_size),
        (count,),
    ]
    assert (scores > 0).sum() > 0.9 * COUNT
    inside = keypoints[scores > 0]
    assert (inside >= BORDER - 1).all()
    assert (inside <= torch.tensor([256.0, 192.0]) - BORDER).all()
    torch.testing.assert_close(descriptors.norm(dim=1), torch.ones(count))
    assert (sigma > 0).all()


@pytest.mark.parametrize("name", EXTRACTIONS)
def test_a_black_image_gives_no_keypoint_with_a_score(name: str, network: FeatureNetwork):
    _, scores, descriptors, sigma = extracted(name, network, torch.zeros(1, 1, 128, 160))
    assert (scores == 0).all()
    assert all(array.isfinite().all() for array in (descriptors, sigma))


def test_the_default_is_what_ships(network: FeatureNetwork, image: Tensor):
    assert EXTRACTIONS["default"] is FeatureExtractor
    assert all(
        not torch.equal(extracted(name, network, image)[0], extracted("default", network, image)[0])
        for name in set(EXTRACTIONS) - {"default"}
    )


def corresponding(keypoints: Tensor, others: Tensor) -> Tensor:
    """Distance of each from the nearest of the others."""
    return torch.cdist(keypoints.double(), others.double()).amin(dim=1)


def test_one_scale_finds_what_several_scales_find_on_the_first(network: FeatureNetwork, image: Tensor):
    one = extracted("one_scale", network, image)[0]
    several = extracted("default", network, image)[0]
    # Three quarters of the keypoints come from the first scale; those are the best of what one scale gives.
    shared = corresponding(several, one) < 1e-3
    assert shared.sum() >= COUNT - COUNT // 4
    assert shared.sum() < COUNT
    with torch.inference_mode():
        level = FeatureExtractor(network)._level(to_cells(image), COUNT)
    for found, expected in zip(extracted("one_scale", network, image), level, strict=True):
        torch.testing.assert_close(found, expected)


def test_three_scales_have_their_shares_in_pixels_of_the_image(network: FeatureNetwork, image: Tensor):
    counts = [int(share * COUNT) for share in extraction._THREE_SHARES]
    keypoints = extracted("three_scales", network, image)[0]
    assert len(keypoints) == sum(counts)
    smaller = image
    with torch.inference_mode():
        for level, found in enumerate(keypoints.split(counts)):
            expected = FeatureExtractor(network)._level(to_cells(smaller), counts[level])[0]
            torch.testing.assert_close(found, (expected + 0.5) * 2**level - 0.5)
            smaller = functional.avg_pool2d(smaller, 2)
            smaller = smaller[:, :, : smaller.shape[2] // 32 * 32, : smaller.shape[3] // 32 * 32]


def test_whole_pixels_are_the_default_rounded(network: FeatureNetwork, image: Tensor):
    keypoints, scores = extracted("whole_pixels", network, image)[:2]
    exact = extracted("default", network, image)[0]
    # Of the image, or of the image at half its size.
    finer, coarser = keypoints == keypoints.round(), keypoints % 2 == 0.5
    assert (finer | coarser).all()
    near = corresponding(keypoints[scores > 0], exact) < 2 * 0.5**0.5 + 1e-3
    # Rounded places have other qualities: a few candidates change places.
    assert near.double().mean() > 0.9


@pytest.mark.parametrize(("name", "other"), [("strength", "quality"), ("quality", "strength")])
def test_rankings_order_the_same_candidates(name: str, other: str, network: FeatureNetwork, image: Tensor):
    with torch.inference_mode():
        strength, quality, sigma = torch.rand(3, 1, 50, generator=torch.Generator().manual_seed(0)) + 0.1
        strength[0, 7] = 0.0
        scores = EXTRACTIONS[name](network)._rank(strength, quality, sigma)
    expected = (strength if name == "strength" else quality).clone()
    expected[0, 7] = 0.0
    torch.testing.assert_close(scores, expected)
    assert not torch.equal(extracted(name, network, image)[0], extracted(other, network, image)[0])


def test_of_two_alike_the_one_of_smaller_sigma_is_ranked_first(network: FeatureNetwork):
    same = torch.full((1, 2), 0.5)
    scores = EXTRACTIONS["sigma"](network)._rank(same, same, torch.tensor([[0.4, 0.8]]))
    torch.testing.assert_close(scores[0, 0], 2.0 * scores[0, 1])


# The responses


def unshuffled(cells: Tensor) -> np.ndarray:
    return np.asarray(functional.pixel_shuffle(cells, 4)[0, 0].numpy())


@pytest.mark.parametrize("blurred", [False, True])
def test_the_shi_tomasi_response_is_opencvs_smaller_eigenvalue(image: Tensor, blurred: bool):
    found = unshuffled(extraction._shi_tomasi(blurred)(to_cells(image)))
    grey = image[0, 0].numpy()
    if blurred:
        taps = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0
        grey = cv2.sepFilter2D(grey, -1, taps, taps)
    inner = np.s_[BORDER:-BORDER, BORDER:-BORDER]
    # OpenCV's window is a box.
    expected = cv2.cornerMinEigenVal(grey, 3, ksize=3)
    assert np.corrcoef(found[inner].ravel(), expected[inner].ravel())[0, 1] > 0.95
    assert found[inner].min() > -1e-7


def test_the_shi_tomasi_response_peaks_on_corners_and_not_on_edges():
    square = np.zeros((96, 96), np.float32)
    square[30:61, 30:61] = 1.0
    response = extraction._shi_tomasi(blurred=True)(to_cells(torch.from_numpy(square)[None, None]))
    keypoints, strength = find_peaks(response, 4)
    assert (strength > 0).all()
    corners = torch.tensor([[29.5, 29.5], [29.5, 60.5], [60.5, 29.5], [60.5, 60.5]])
    assert (torch.cdist(corners, keypoints[0]).amin(dim=1) < 2.0).all()
    middle_of_an_edge = unshuffled(response)[45, 30]
    assert middle_of_an_edge < 0.01 * unshuffled(response).max()


def test_saddles_count_a_quarter_of_blobs():
    v, u = np.mgrid[:96, :96] - 47.5
    bump = np.exp(-0.5 * (u**2 + v**2) / 3.0**2)
    blob, saddle = (0.5 + 0.4 * shape * bump for shape in (np.ones_like(u), u * v / 9.0))
    for picture in (blob, saddle):
        cells = to_cells(torch.from_numpy(picture.astype(np.float32))[None, None])
        plain = unshuffled(extraction.hessian_response(cells))
        both = unshuffled(extraction._blobs_and_saddles(cells))
        np.testing.assert_allclose(both, np.maximum(plain, -0.25 * plain), rtol=1e-5, atol=1e-9)
        assert both[47, 47] > 0
