"""Renders beside real images: statistics of the images, odometry with SIFT, and how fast they are made."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import combinations
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sigmaslam.errors import InputError
from sigmaslam.files import save_png
from sigmaslam.plot_style import BLACK, GREY, SERIES, style_axes
from sigmaslam.readers import open_sequence
from sigmaslam_benchmarks.matching.photographs import read_grey
from sigmaslam_benchmarks.tracking import image_statistics as statistics
from sigmaslam_benchmarks.tracking import render_odometry as odometry
from sigmaslam_benchmarks.tracking import render_speed as speed
from sigmaslam_benchmarks.tracking.image_statistics import ImageSet
from sigmaslam_benchmarks.tracking.page import fill_page, write_page

_RAW = "KITTI raw"  # before it was rectified: what the sensor itself does
_SET12, _KITTI, _EUROC = "denoising/Set12", odometry.REAL_DRIVE, "euroc_v1_01_keyframes_a"
REAL = {"KITTI": _KITTI, "EuRoC": _EUROC, "Set12": _SET12}
"""Names of the real sets and their folders."""
PAIRS = (("street", "KITTI"), ("drone", "EuRoC"), ("room", "EuRoC"), ("leaves", "Set12"))
"""Like with like: renders, and the real images they stand for."""
ALONE = ("colon", "organ", "tool")
"""Renders of what no real set here shows."""
_KITTI_STEP, _EUROC_STEP, _DRIVE_STEP = 9, 3, 10  # every so many frames an image is taken
_SEEDS = (0, 1, 2)
_EPISODE = 24  # frames
_MOMENTS = (0, 8, 16, 23)  # frames of it that are taken
_LEAVES, _LEAVES_SIZE = 60, 224

# Row of the figure: title, renders and real sets in it.
_PANELS = (
    ("street", ("street",), ("KITTI", _RAW)),
    ("indoors", ("drone", "room"), ("EuRoC",)),
    ("dead leaves", ("leaves",), ("Set12",)),
    ("medical", ALONE, ()),
)


@dataclass(frozen=True, slots=True)
class Difference:
    """How one set of images differs from another.

    Attributes:
        distance: not negative; zero for equal sets.
        words: what is different, with its figure.
    """

    distance: float
    words: str


def write_renders(
    path: Path,
    figure: Path,
    data: Path,
    command: str,
    note: Callable[[str], None] = lambda text: None,
    scratch: Path | None = None,
) -> str:
    """Measures everything, writes the page and its figure and returns the page.

    Args:
        scratch: folder whose rendered drives are used and kept; none: a temporary one.
    Raises:
        InputError: `data` does not hold the real sets.
    """
    missing = [name for name in (*REAL.values(), odometry.PROFILE) if not (data / name).exists()]
    if missing:
        raise InputError(f"{data} does not hold {', '.join(missing)}: give the folder of the data sets with --data")
    # First of all, while nothing else of ours has warmed or filled the machine.
    machine = speed.describe_machine()
    speeds = speed.measure_speeds(note)
    with tempfile.TemporaryDirectory() as temporary:
        drives = odometry.render_drives(scratch or Path(temporary), data, note)
        note("tracking the drives")
        real = odometry.follow("KITTI", data / _KITTI, data / _KITTI / "poses.txt")
        renders = [odometry.follow(drive.name, drive, drive / "poses.txt") for drive in drives]
        note("statistics of the images")
        sets = summarize_all(data, drives)
    save_png(draw(sets), figure)
    low, high = statistics.MID_BAND
    page = fill_page(
        "renders",
        command,
        machine=machine,
        figure=figure.name,
        blur=f"{statistics.BLUR:g}",
        flat=f"{statistics.FLAT:g}",
        band=f"{low:g} to {high:g}",
        levels=" / ".join(f"{level:g}" for level in statistics.CORNER_LEVELS),
        strongest=f"{statistics.CORNERS_PER_10000:g}",
        white=f"{statistics.BRIGHTNESS_EDGES[-2]:g}",
        raw=_RAW,
        sets=[
            _set_cells(f"**{name}**" if name in (*REAL, _RAW) else name, sets[name])
            for name in (*REAL, _RAW, *(name for name, _ in PAIRS), *ALONE)
        ],
        **_compare_all(sets),
        drive=_KITTI,
        drives=renders,
        real=real,
        odometry=odometry,
        limit=f"{odometry.LIMIT:g}",
        **odometry.compare_drives(real, renders),
        processes=speed.PROCESSES,
        speeds=speed.speed_rows(speeds),
    )
    return write_page(path, page)


def summarize_all(data: Path, drives: Sequence[Path]) -> dict[str, ImageSet]:
    """Statistics of all real and rendered sets by name.

    Args:
        data: folder of the real data sets.
        drives: rendered sequences of the street.
    """
    images = {
        "KITTI": _lefts(data / _KITTI, _KITTI_STEP),
        "EuRoC": _lefts(data / _EUROC, _EUROC_STEP),
        "Set12": [read_grey(path) for path in sorted((data / _SET12).glob("*.png"))],
        _RAW: [read_grey(path) for path in sorted((data / _KITTI / "raw_unrectified").rglob("*.png"))],
        "street": [image for drive in drives for image in _lefts(drive, _DRIVE_STEP)],
        **_render_presets([*(name for name, _ in PAIRS if name not in ("street", "leaves")), *ALONE]),
        "leaves": _leaves(),
    }
    return {name: statistics.summarize(name, images[name]) for name in images}


def compare(one: ImageSet, other: ImageSet) -> dict[str, Difference]:
    """What differs in `one` from `other`, by statistic.

    Distances: of histograms Wasserstein's, in decades or grey levels; of ratios |log2|; else absolute differences.
    """
    gradient, brightness, strength = (
        statistics.wasserstein(first / first.sum(), second / second.sum(), edges)
        for first, second, edges in (
            (one.gradient, other.gradient, statistics.GRADIENT_EDGES),
            (one.brightness, other.brightness, statistics.BRIGHTNESS_EDGES),
            (one.strength, other.strength, statistics.STRENGTH_EDGES),
        )
    )
    slope = one.slope - other.slope
    repeated, scatter = (
        one.repeatability[0] - other.repeatability[0],
        np.hypot(one.repeatability[1], other.repeatability[1]),
    )
    both = np.isfinite(one.noise) & np.isfinite(other.noise)
    noise = float(np.median(one.noise[both] / other.noise[both])) if both.any() else np.nan
    medians = one.median_gradient / other.median_gradient
    return {
        "log gradient": Difference(gradient, f"{gradient:.2f} decades, median x{medians:.2f}"),
        "flat pixels": _ratio(one.flat, other.flat),
        "slope": Difference(abs(slope), f"{slope:+.2f}"),
        "corner strength": Difference(strength, f"{strength:.2f} decades"),
        **{
            f"corners of {level:g}": _ratio(float(one.corner_density[k]), float(other.corner_density[k]))
            for k, level in enumerate(statistics.CORNER_LEVELS)
        },
        # Two standard errors are no difference.
        "repeatability": Difference(
            max(abs(repeated) - 2 * scatter, 0.0), f"{100 * repeated:+.0f} ± {100 * scatter:.0f} %"
        ),
        "brightness": Difference(brightness, f"{brightness:.0f} grey levels"),
        "noise": _ratio(noise, 1.0),
    }


def gaps(difference: Mapping[str, Difference], yardstick: Mapping[str, float]) -> list[tuple[str, float, str]]:
    """Statistics whose distance exceeds the yardstick, worst first: name, how many times as far, words."""
    found = [
        (name, entry.distance / max(yardstick[name], 1e-9), entry.words)
        for name, entry in difference.items()
        if entry.distance > yardstick[name]
    ]
    return sorted(found, key=lambda gap: -gap[1])


def real_yardstick(sets: dict[str, ImageSet]) -> dict[str, float]:
    """Median distance between the real sets, by statistic; not less than a hundredth, which is nothing of any."""
    found = [compare(sets[one], sets[other]) for one, other in combinations(REAL, 2)]
    return {key: max(float(np.median([difference[key].distance for difference in found])), 0.01) for key in found[0]}


def draw(sets: dict[str, ImageSet]) -> Figure:
    """A row a kind of scene, a column a statistic; real sets in black and grey."""
    figure = Figure(figsize=(20, 14), layout="constrained")
    grid = figure.subplots(len(_PANELS), 5)
    for line, (title, renders, real) in zip(grid, _PANELS, strict=True):
        names = [*real, *renders]
        colours = dict(zip(names, [BLACK, GREY][: len(real)] + list(SERIES), strict=False))
        for name in names:
            style = {"color": colours[name], "lw": 2.2 if name in real else 1.5, "label": name}
            _draw_set(line, sets[name], style)
        for axes, (label, heading) in zip(line, _AXES, strict=True):
            axes.set_xlabel(label)
            axes.set_title(f"{title}: {heading}", fontsize=10)
            style_axes(axes)
        line[4].set_ylim(0, None)  # last, or what is drawn later would be cut off
        line[0].legend(fontsize=9)
    return figure


_AXES = (
    ("gradient [grey levels / pixel]", "share of pixels"),
    ("frequency [cycles / pixel]", "power density"),
    ("strength at least [grey levels / pixel]", "corners per $10^4$ pixels"),
    ("brightness [grey levels]", "share of pixels"),
    ("brightness [grey levels]", "noise [grey levels]"),
)


def _draw_set(line: Sequence[Axes], images: ImageSet, style: dict[str, Any]) -> None:
    gradient, spectrum, corner, brightness, noise = line
    gradient.semilogx(_centres(statistics.GRADIENT_EDGES, log=True)[1:-1], images.gradient[1:-1], **style)
    spectrum.loglog(images.frequencies, images.density, **style)
    stronger = np.cumsum(images.strength[::-1])[::-1]
    corner.loglog(10.0 ** statistics.STRENGTH_EDGES[:-1], stronger, **style)
    for level in statistics.CORNER_LEVELS:
        corner.axvline(level, color=GREY, lw=0.8, ls=":")
    corner.set_xlim(0.5, 60.0)
    corner.set_ylim(0.03, 300.0)
    brightness.plot(_centres(statistics.BRIGHTNESS_EDGES), images.brightness, **style)
    noise.plot(_centres(statistics.BRIGHTNESS_EDGES), images.noise, marker=".", **style)


def _centres(edges: np.ndarray, log: bool = False) -> np.ndarray:
    middle = 0.5 * (edges[1:] + edges[:-1])
    return np.asarray(10.0**middle if log else middle)


def _ratio(one: float, other: float) -> Difference:
    ratio = max(one, 1e-9) / max(other, 1e-9)
    return Difference(abs(float(np.log2(ratio))), f"x{ratio:.2f}")


def _set_cells(name: str, images: ImageSet) -> list[str]:
    """A row of the table of sets."""
    greys = [statistics.quantile(images.brightness, statistics.BRIGHTNESS_EDGES, q) for q in (0.1, 0.5, 0.9)]
    return [
        name,
        str(images.count),
        f"{images.median_gradient:.2f}",
        f"{100 * images.flat:.0f}",
        f"{images.slope:.2f}",
        " / ".join(f"{density:.1f}" for density in images.corner_density),
        f"{100 * images.repeatability[0]:.0f} ± {100 * images.repeatability[1]:.0f}",
        " / ".join(f"{grey:.0f}" for grey in greys),
        f"{100 * images.brightness[-1]:.1f}",
        f"{images.median_noise:.2f} ({np.nanmin(images.noise):.2f} - {np.nanmax(images.noise):.2f})",
    ]


def _compare_all(sets: dict[str, ImageSet]) -> dict[str, Any]:
    """What the page says of renders beside real sets, and of these beside each other."""
    yardstick = real_yardstick(sets)
    rows, sentences = [], {}
    for one, other in (*PAIRS, *combinations(REAL, 2)):
        label, difference = f"{one} against {other}", compare(sets[one], sets[other])
        words = [
            f"**{entry.words}**" if one not in REAL and entry.distance > yardstick[key] else entry.words
            for key, entry in difference.items()
        ]
        rows.append([label, *words])
        if one not in REAL:
            found = [f"{key} {words} ({times:.1f} yardsticks)" for key, times, words in gaps(difference, yardstick)]
            sentences[label] = "; ".join(found) if found else "nothing"
    return {"yardstick": list(yardstick), "differences": rows, "gaps": sentences}


def _lefts(folder: Path, step: int) -> list[np.ndarray]:
    return [frame.left for frame in open_sequence(folder).frames() if frame.index % step == 0]


def _leaves() -> list[np.ndarray]:
    from sigmaslam_synthetic.homography_pairs import HomographyPairs

    pairs = HomographyPairs(0, _LEAVES_SIZE)
    return [np.rint(255.0 * pairs.pair(k).image0).astype(np.uint8) for k in range(_LEAVES)]


def _render_presets(presets: Sequence[str]) -> dict[str, list[np.ndarray]]:
    """Left images of a few moments of several worlds of each preset, at the preset's own size."""
    jobs = [(preset, seed) for preset in presets for seed in _SEEDS]
    images: dict[str, list[np.ndarray]] = {preset: [] for preset in presets}
    with ProcessPoolExecutor(speed.PROCESSES, get_context("spawn")) as pool:
        for (preset, _), found in zip(jobs, pool.map(_moments, *zip(*jobs, strict=True)), strict=True):
            images[preset] += found
    return images


def _moments(preset: str, seed: int) -> list[np.ndarray]:
    import torch

    from sigmaslam_synthetic.simulation import Recipe, Studio, simulate

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    studio = Studio(simulate(Recipe(preset, _EPISODE, seed)))
    with torch.inference_mode():
        return [studio.frames(np.array([moment]))[0].left for moment in _MOMENTS]
