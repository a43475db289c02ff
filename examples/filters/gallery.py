"""The filters' gallery: runs each example, draws it, and prints lines, processor seconds and results as CSV.

`python examples/filters/gallery.py docs/images/filters MRCLAM_Dataset6 > docs/filters.gallery.csv` makes the gallery of
docs/filters.md; without the second folder the robots are left out.
"""

from __future__ import annotations

import csv
import importlib
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).parent))
Run = Callable[[Any], dict[str, float]]


def several_sensors(axes: Any) -> dict[str, float]:
    """The vehicle of `fuse_vehicle`, 2,000 events."""
    vehicle = importlib.import_module("fuse_vehicle")
    streams, order, truth = vehicle.simulate(2000)
    track = vehicle.FILTER.filter_events(vehicle.start(), vehicle.interleaved(streams, order))
    fixes = streams[0].value
    axes.plot(*fixes.T, ".", ms=3, label="GPS")
    axes.plot(*track.filtered.mean[:, :2].T, lw=1, label="filtered")
    axes.plot(*truth[:, :2].T, lw=1, label="truth")
    axes.legend()
    smoothed = vehicle.FILTER.smooth(track).mean
    return {"rms [m]": vehicle.rms(track.filtered.mean - truth), "smoothed": vehicle.rms(smoothed - truth)}


def learn_noise(axes: Any) -> dict[str, float]:
    """The log-likelihood of `learn_noise` along its deviations, and its maximum."""
    pendulum = importlib.import_module("learn_noise")
    values, fast = pendulum.simulate(), pendulum.compile_filter(pendulum.FILTER).filter_events
    found = pendulum.learn(values, fast)
    grid = torch.logspace(-2, 0.5, 25, dtype=torch.float64)
    for k, name in enumerate(("process", "shadow")):
        at = [found.clone().index_fill(0, torch.tensor([k]), float(each)).log() for each in grid]
        with torch.no_grad():
            curve = [float(pendulum.log_likelihood(each, values, fast)) for each in at]
        axes.semilogx(grid, curve, label=name)
        axes.axvline(float(pendulum.TRUTH[k]), color=f"C{k}", ls=":")
    axes.set_ylim(max(curve) - 60, max(curve) + 5)
    axes.legend()
    return {"process / true": float(found[0] / pendulum.TRUTH[0]), "shadow / true": float(found[1] / pendulum.TRUTH[1])}


def robot_among_landmarks(folder: Path) -> Run:
    """Five robots of `localise_robot`, five minutes."""

    def run(axes: Any) -> dict[str, float]:
        robots = importlib.import_module("localise_robot")
        found = {}
        for k, (name, options) in enumerate({"plain": {}, "Student's t": {"robust": "student_t"}}.items()):
            position, _ = robots.localise(folder, 300.0, **options)
            axes.bar(np.arange(5) + 0.4 * k, position, 0.4, label=name)
            found[f"rms, {name} [m]"] = float(position.mean())
        axes.legend()
        return found

    return run


def export(axes: Any) -> dict[str, float]:
    """The dial of `export_my_filter` as a graph."""
    dial = importlib.import_module("export_my_filter")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "dial.onnx"
        difference = dial.export(path)
        counts = range(5, 65, 5)
        errors = [abs(dial.run(path, steps)) for steps in counts]
    axes.semilogy(counts, errors, ".-")
    return {"off from torch": difference, "off from the truth [rad]": errors[-1]}


def example(name: str) -> Run:
    """A script's own `run`."""
    return lambda axes: importlib.import_module(name).run(axes)


def main(pictures: Path, robots: Path | None) -> None:
    """All of them."""
    rows: list[tuple[str, str, Run | None]] = [
        ("Several sensors at several rates", "fuse_vehicle", several_sensors),
        ("Irregular time steps", "irregular_times", None),
        ("Missing data", "missing_data", None),
        ("Quaternions in a UKF", "quaternions", None),
        ("Delayed measurements", "delayed_measurements", None),
        ("Outliers and gates", "outliers_and_gates", None),
        ("Smoothing with a fixed lag", "fixed_lag", None),
        ("Learn Q and R", "learn_noise", learn_noise),
        ("A thousand targets at once", "many_targets", None),
        ("Particle filter beside UKF", "particles_beside_ukf", None),
        ("Export to ONNX and to C++", "export_my_filter", export),
    ]
    if robots is not None:
        rows.append(("Robot among landmarks", "localise_robot", robot_among_landmarks(robots)))
    pictures.mkdir(parents=True, exist_ok=True)
    table = csv.writer(sys.stdout, lineterminator="\n")
    table.writerow(["example", "lines", "CPU [s]", "result"])
    for title, name, run in rows:
        figure = Figure(figsize=(5.6, 2.4), layout="constrained")
        axes = figure.add_subplot()
        begun = time.process_time()
        found = (run or example(name))(axes)
        seconds = time.process_time() - begun
        figure.savefig(pictures / f"{name}.png", dpi=80)
        lines = len((Path(__file__).parent / f"{name}.py").read_text().splitlines())
        table.writerow([title, lines, f"{seconds:.1f}", ", ".join(f"{k} {v:.3g}" for k, v in found.items())])


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None)
