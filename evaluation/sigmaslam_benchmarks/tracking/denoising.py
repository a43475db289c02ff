"""The page of image filtering: Set12, other noise, sequences, and the tracker in the dark."""

import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_path, make_folder
from sigmaslam.image_filtering import NoiseModel, SequenceFilter, denoise_image, estimate_noise, filter_both_ways
from sigmaslam.readers.images import read_grey
from sigmaslam.readers.pairing import list_images
from sigmaslam.runs.denoise import to_bytes
from sigmaslam.runs.request import TrackerOptions
from sigmaslam_benchmarks.tracking.page import fill_page, write_page
from sigmaslam_benchmarks.trial import Trial, render, track_ours
from sigmaslam_evaluation.truth_conventions import find_truth
from sigmaslam_synthetic.camera.sensor import Sensor, expose
from sigmaslam_synthetic.simulation import Recipe

SIGMAS = (15.0, 25.0, 50.0)
RECIPES = tuple(Recipe(preset, 30, 1000, width=400, height=300) for preset in ("room", "street"))
"""Seeds from 1000 on are used for nothing but pages."""
NIGHTS = {
    "as rendered": None,
    "photons at white 100, read noise 5": Sensor(blur=0.0, photons_at_white=100.0, read_noise=5.0),
    "photons at white 10, read noise 20": Sensor(blur=0.0, photons_at_white=10.0, read_noise=20.0),
    "a twentieth of the light, read noise 1.5": Sensor(blur=0.0, gain=0.05, photons_at_white=2000.0, read_noise=1.5),
}
"""Sensors before which a rendered sequence is shown again."""
_REAL = ("kitti_raw_0926_0039_a", "euroc_mh01_f000_099")
_SEQUENCE_FRAMES, _FIRST, _AFTER = 16, 4, 4

Filter = Callable[[np.ndarray, NoiseModel], np.ndarray]
Spoil = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def write_denoising(
    path: Path, data: Path, runs: Path, command: str, note: Callable[[str], None] = lambda text: None
) -> str:
    """Writes the page and returns it; notes in it are kept. A picture goes beside it.

    Raises:
        InputError: a data set is missing.
    """
    images = [read_grey(each) for each in list_images(data / "denoising" / "Set12")]
    make_folder(runs)
    sources = {}
    for recipe in RECIPES:
        sources[recipe.name] = render(runs, recipe, 1)
        note(f"{recipe.name} is there")
    parts: dict[str, Callable[[], Iterator[list[str]]]] = {
        "gaussian": partial(_gaussian, images),
        "others": partial(_others, images),
        "blurred": partial(_blurred, images),
        "sequences": partial(_sequences, data, sources),
        "night": partial(_night, sources, runs),
    }
    picture = path.with_suffix(".jpg")
    values: dict[str, Any] = {
        **{name: [] for name in parts},
        "picture": "",
        "sigmas": [f"{sigma:.0f}" for sigma in SIGMAS],
        "filters": [name for name in _FILTERS if "thorough" not in name],
        "first": _FIRST,
        "last": _SEQUENCE_FRAMES - _AFTER - 1,
        "frames": RECIPES[0].frames,
    }
    page, threads = "", cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for name, part in parts.items():
            values[name] = list(part())
            note(f"{name}: {values[name][-1]}")
            page = write_page(path, fill_page("denoising", command, **values))
        draw_sequences(picture, [data / _REAL[0], *sources.values()])
        page = write_page(path, fill_page("denoising", command, **values | {"picture": picture.name}))
    finally:
        cv2.setNumThreads(threads)
    return page


def psnr(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Peak signal-to-noise ratio of grey levels of 255, dB; infinite where both are the same."""
    square = float(np.mean((estimate.astype(np.float64) - truth) ** 2))
    return float("inf") if square == 0 else 10 * float(np.log10(255.0**2 / square))


def non_local_means(image: np.ndarray, noise: NoiseModel) -> np.ndarray:
    """OpenCV's, for the mean variance of the noise: 7 x 7 patches in 21 x 21 pixels, h = 0.9 sigma."""
    sigma = float(np.sqrt(noise.variance(image).mean()))
    return np.asarray(cv2.fastNlMeansDenoising(to_bytes(image), None, 0.9 * sigma, 7, 21))


_FILTERS: dict[str, Filter] = {
    "noisy": lambda image, noise: image,
    "median 3 x 3": lambda image, noise: cv2.medianBlur(to_bytes(image), 3),
    "OpenCV non-local means": non_local_means,
    "ours": denoise_image,
    "ours, thorough": partial(denoise_image, thorough=True),
}


def _gaussian(images: list[np.ndarray]) -> Iterator[list[str]]:
    """Filters on Set12 with Gaussian noise of each sigma, which is given."""
    scores: dict[str, list[list[float]]] = {name: [] for name in _FILTERS}
    seconds: dict[str, list[float]] = {name: [] for name in _FILTERS}
    for sigma in SIGMAS:
        rng = np.random.default_rng(0)
        noisy = [image + rng.normal(0.0, sigma, image.shape) for image in images]
        for name, filter_one in _FILTERS.items():
            found = []
            for image, truth in zip(noisy, images, strict=True):
                began = time.process_time()
                found.append(psnr(filter_one(image, NoiseModel(sigma)), truth))
                if truth.shape == (256, 256):
                    seconds[name].append(time.process_time() - began)
            scores[name].append(found)
    for name, rows in scores.items():
        taken = "" if name == "noisy" else f"{np.median(seconds[name]):.3f}"
        yield [name, *(f"{np.mean(each):.2f}" for each in rows), taken]


def _others(images: list[np.ndarray]) -> Iterator[list[str]]:
    """Other noise on Set12, which is estimated."""
    kinds: dict[str, Spoil] = {
        "Gaussian, sigma 25, clipped": lambda image, rng: image + rng.normal(0.0, 25.0, image.shape),
        "Poisson, 30 photons at white": lambda image, rng: rng.poisson(image * (30 / 255)) * (255 / 30),
        "quantised to 4 bits": lambda image, rng: np.rint(image / 17.0) * 17.0,
        "salt and pepper, 10 %": partial(_salt_and_pepper, share=0.1),
        "salt and pepper, 30 %": partial(_salt_and_pepper, share=0.3),
    }
    for kind, spoil in kinds.items():
        rng = np.random.default_rng(0)
        noisy = [to_bytes(spoil(image, rng)) for image in images]
        pairs = [(image, estimate_noise(image)) for image in noisy]
        cells = [
            np.mean([psnr(one(*each), truth) for each, truth in zip(pairs, images, strict=True)])
            for name, one in _FILTERS.items()
            if "thorough" not in name
        ]
        yield [kind, *(f"{each:.2f}" for each in cells)]


def _blurred(images: list[np.ndarray]) -> Iterator[list[str]]:
    """Set12 through a lens out of focus."""
    for blur, sigma in ((1.6, 2.0), (1.6, 10.0), (3.0, 2.0)):
        rng, scores = np.random.default_rng(0), []
        for truth in images:
            soft = _blur(truth.astype(np.float32), blur)
            noisy = to_bytes(soft + rng.normal(0.0, sigma, truth.shape))
            own = estimate_noise(noisy)
            told = [denoise_image(noisy, replace(own, blur=share * blur)) for share in (1.0, 0.8, 1.2)]
            masked = 2.0 * noisy - _blur(noisy.astype(np.float32), blur)
            scores.append([psnr(to_bytes(each), truth) for each in (noisy, masked, *told)])
        means = np.mean(scores, axis=0).tolist()
        yield [f"{blur} px, sigma {sigma:.0f}", *(f"{each:.2f}" for each in means)]


def _blur(image: np.ndarray, sigma: float) -> np.ndarray:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT))


def _salt_and_pepper(image: np.ndarray, rng: np.random.Generator, share: float) -> np.ndarray:
    drawn = rng.random(image.shape)
    return np.where(drawn < share / 2, 0, np.where(drawn > 1 - share / 2, 255, image))


def _sequences(data: Path, sources: dict[str, Path]) -> Iterator[list[str]]:
    """Rendered and real sequences, each image by itself and over time."""
    chosen = {**sources, **{name: data / name for name in _REAL}}
    for name, source in chosen.items():
        noise = NoiseModel(25.0)
        truths, images = _noisy_images(source)
        forward = SequenceFilter(noise)
        alone, before = [denoise_image(image, noise) for image in images], [forward.step(image) for image in images]
        began = time.process_time()
        both = list(filter_both_ways(images, SequenceFilter(noise)))
        seconds = time.process_time() - began
        rows = list(zip(truths, images, alone, before, both, strict=True))[_FIRST:-_AFTER]
        mean = np.mean([[psnr(each, truth) for each in others] for truth, *others in rows], axis=0)
        cells = [f"{each:.2f}" for each in (*mean, mean[3] - mean[1])]
        yield [name, *cells, f"{seconds / len(images):.3f}"]


def draw_sequences(path: Path, sources: list[Path]) -> None:
    """Writes a picture: for each sequence a part of its last frame noisy, filtered by itself, and over time."""
    rows = []
    for source in sources:
        noise, (_, images) = NoiseModel(25.0), _noisy_images(source)
        last = len(images) - _AFTER - 1
        image, result = images[last], list(filter_both_ways(images, SequenceFilter(noise)))[last]
        top, left = (image.shape[0] - 200) // 2, (image.shape[1] - 300) // 2
        part = slice(top, top + 200), slice(left, left + 300)
        rows.append(np.hstack([to_bytes(each[part]) for each in (image, denoise_image(image, noise), result)]))
    with atomic_path(path) as temporary:
        cv2.imwrite(str(temporary), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 80])


def _noisy_images(source: Path) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Left images, and the same with noise of sigma 25."""
    rng, truths = np.random.default_rng(0), list(_left_images(source))
    return truths, [truth + rng.normal(0.0, 25.0, truth.shape) for truth in truths]


def _left_images(source: Path) -> Iterator[np.ndarray]:
    for folder in ("image_0", "image_l", "image_00/data", "mav0/cam0/data"):
        if (source / folder).is_dir():
            return (read_grey(path) for path in list_images(source / folder)[:_SEQUENCE_FRAMES])
    raise InputError(f"{source}: no folder of left images; fetch the data set again")


def _night(sources: dict[str, Path], runs: Path) -> Iterator[list[str]]:
    """The tracker on sequences that are shown again to darker sensors."""
    for name, source in sources.items():
        for night, sensor in NIGHTS.items():
            shown = source
            if sensor is not None:
                shown = runs / "dark"
                show_again(source, shown, sensor)
            cells: list[str] = []
            for denoise in (False, True):
                cells += _track(shown, denoise)
            if sensor is not None:
                shutil.rmtree(shown)
            yield [name, night, *cells]


def _track(source: Path, denoise: bool) -> list[str]:
    """Error and frames that were tracked."""
    method = partial(track_ours, tracker=TrackerOptions(threads=1, denoise=denoise))
    try:
        result = Trial(source, find_truth(source), method).run()
    except InputError:
        return ["lost", "0"]
    return [f"{1e3 * result.evaluation.ate.rmse:.1f}", str(int(result.tracked.sum()))]


def show_again(source: Path, out: Path, sensor: Sensor) -> None:
    """Writes a rendered KITTI folder as another sensor would have seen it, grey levels of the first taken for light.

    Args:
        source: rendered with a gamma of 1.
        out: new folder.
        sensor: that sees the images.
    """
    shutil.copytree(source, out, ignore=shutil.ignore_patterns("truth", "landmarks.npz"))
    rng = np.random.default_rng(0)
    for eye in ("image_0", "image_1"):
        for path in list_images(out / eye):
            cv2.imwrite(str(path), expose(read_grey(path) / np.float32(255.0), sensor, rng))
