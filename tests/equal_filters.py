"""Hashes of what filters return in each of their forms: two commits that must not differ are compared to the bit.

python -m tests.equal_filters OUT.json                      # runs, and writes the hashes
python -m tests.equal_filters OUT.json --against OTHER.json # exits with 1 where a hash differs
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import sigmaslam_filters as filters
from tests.support.filter_builders import beliefs, bent_measurement, bent_motion, noises, random_numbers

# States and measured components: small, alike, more measurements than columns, and 70 states.
SIZES = ((3, 2), (4, 4), (3, 12), (9, 12), (70, 6))
BATCHES = ((), (2, 3), (150,))
FORMS = ("auto", "dense", "low-rank", "qr")
OUTLIERS: tuple[dict[str, Any], ...] = ({}, {"gate": 0.99}, {"robust": "student_t"}, {"gate": 0.9, "robust": "huber"})


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path, help="JSON file for the hashes")
    parser.add_argument("--against", type=Path, help="hashes of another commit")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    hashes = dict([*_updates(), *_settings(), *_manifolds(), *_sequences()])
    arguments.out.write_text(json.dumps(hashes, indent=1) + "\n", encoding="utf-8")
    if arguments.against:
        other = json.loads(arguments.against.read_text(encoding="utf-8"))
        differing = [key for key in sorted({*hashes, *other}) if hashes.get(key) != other.get(key)]
        print(f"{len(hashes)} results, {len(differing)} of them differ", *differing, sep="\n  ")
        sys.exit(bool(differing))


def _updates() -> Iterator[tuple[str, str]]:
    """Every form, for sizes, batches, noises, dtypes and outliers; a few components are missing."""
    for (n, m), batch, form in product(SIZES, BATCHES, FORMS):
        if n == 70 and batch == (150,):
            continue
        bayes = filters.UnscentedKalmanFilter(form=form)  # type: ignore[arg-type]
        value = random_numbers(*batch, m, seed=5)
        for (kind, noise), options in product(noises(m).items(), OUTLIERS):
            for dtype in (torch.float64, torch.float32):
                if dtype == torch.float32 and (kind != "diagonal" or n == 70):
                    continue
                prior = beliefs(*batch, n).to(dtype)
                see = bent_measurement(
                    n, m, noise if dtype == torch.float64 else filters.Diagonal(noise.variance().float())
                )
                for missing in (False, True):
                    given = torch.where(value < -1, torch.nan, value) if missing else value
                    name = f"update {n} {m} {batch} {form} {kind} {options} {dtype} {missing}"
                    yield name, _hash(lambda: bayes.update(prior, see, given.to(dtype), **options))  # noqa: B023


def _settings() -> Iterator[tuple[str, str]]:
    """Filters, iterations, policies, noise within the function, given derivatives, and negative weights."""
    kinds = {
        "ekf": filters.ExtendedKalmanFilter(),
        "ukf": filters.UnscentedKalmanFilter(),
        "simplex": filters.UnscentedKalmanFilter(points=filters.Simplex()),
        "julier": filters.UnscentedKalmanFilter(points=filters.julier(-1.0, allow_negative=True), form="dense"),
    }
    within = filters.MeasurementModel(
        lambda x, v: x[..., :2].sin() + x[..., 1:3] * v,
        filters.Diagonal(torch.full((2,), 0.1).double()),
        additive=False,
    )
    for (kind, bayes), iterations, batch in product(kinds.items(), ("auto", 1, 3), BATCHES):
        for policy in ("raise", "hold", "jitter"):
            one = replace(bayes, iterations=iterations, on_failure=policy)
            prior, value = beliefs(*batch, 3), random_numbers(*batch, 2)
            name = f"{kind} {iterations} {batch} {policy}"
            yield f"{name} additive", _hash(lambda: one.update(prior, bent_measurement(3, 2), value))  # noqa: B023
            yield f"{name} within", _hash(lambda: one.update(prior, within, value))  # noqa: B023
            yield f"{name} predict", _hash(lambda: one.predict(prior, bent_motion(3)))  # noqa: B023
            if batch and policy != "raise":
                broken = prior.covariance.clone()
                broken[0] = -broken[0]
                spoilt = filters.Gaussian(prior.mean, broken)
                yield f"{name} spoilt", _hash(lambda: one.update(spoilt, bent_measurement(3, 2), value))  # noqa: B023
    linear = filters.LinearMeasurement(random_numbers(2, 3), filters.Diagonal(torch.full((2,), 0.1).double()))
    for form, batch in product(FORMS, BATCHES):
        kf = filters.KalmanFilter(form=form)  # type: ignore[arg-type]
        yield f"kf {form} {batch}", _hash(lambda: kf.update(beliefs(*batch, 3), linear, random_numbers(*batch, 2)))  # noqa: B023


def _manifolds() -> Iterator[tuple[str, str]]:
    for space, make, batch in product(
        (filters.SE2("right"), filters.SE3(), filters.Product(filters.SE3(), filters.Euclidean(6))),
        (filters.ExtendedKalmanFilter, filters.UnscentedKalmanFilter),
        BATCHES,
    ):
        n = 3 if isinstance(space, filters.SE2) else 6 if isinstance(space, filters.SE3) else 12
        tangent = beliefs(*batch, n, scale=0.1)
        start = torch.zeros(3) if n == 3 else torch.eye(7)[6] if n == 6 else torch.eye(13)[6]
        mean = space.retract(start.double().expand(*batch, -1), tangent.mean)
        prior = filters.Gaussian(mean, tangent.covariance)
        see = filters.MeasurementModel(
            lambda x: x[..., :3].sin() + x[..., -1:], filters.Diagonal(torch.full((3,), 0.05).double())
        )
        move = filters.MotionModel(
            lambda x, s=space, n=n: s.retract(x, torch.full((n,), 0.1).double().expand(*x.shape[:-1], n)),
            0.01 * torch.eye(n).double(),
        )
        for form, options in product(("auto", "qr"), OUTLIERS):
            bayes = make(space, form=form)
            value = random_numbers(*batch, 3, seed=2)
            name = f"{type(space).__name__} {n} {make.__name__} {batch} {form} {options}"
            yield f"{name} update", _hash(lambda: bayes.update(prior, see, value, **options))  # noqa: B023
            yield f"{name} predict", _hash(lambda: bayes.predict(prior, move))  # noqa: B023


def _sequences() -> Iterator[tuple[str, str]]:
    for batch, form, options in product(BATCHES, ("auto", "qr"), OUTLIERS):
        bayes = filters.UnscentedKalmanFilter(form=form)  # type: ignore[arg-type]
        values = random_numbers(5, *batch, 2)

        def run() -> Any:
            track = bayes.filter(beliefs(*batch, 3), bent_motion(3), bent_measurement(3, 2), values, **options)  # noqa: B023
            return [track, bayes.smooth(track), bayes.smooth(track, lag=2)]  # noqa: B023

        yield f"sequence {batch} {form} {options}", _hash(run)


def _hash(run: Any) -> str:
    """SHA-256 of all numbers that a call returns, or of what it raises."""
    digest = hashlib.sha256()
    try:
        for number in _numbers(run()):
            digest.update(str((number.dtype, tuple(number.shape))).encode() + number.contiguous().numpy().tobytes())
    except (ValueError, filters.FilterError) as error:
        digest.update(f"{type(error).__name__}: {error}".encode())
    return digest.hexdigest()


def _numbers(result: Any) -> list[Tensor]:
    if isinstance(result, list):
        return [number for each in result for number in _numbers(each)]
    if isinstance(result, filters.Gaussian):
        return [result.mean, result.held]
    if isinstance(result, filters.Track):
        others = [result.innovation, result.nis, result.count, result.log_likelihood, result.healthy]
        return [*_numbers(result.predicted), *_numbers(result.filtered), *others]
    if isinstance(result, filters.TimeUpdate):
        odd, even, root = result.joint_root()
        return [*_numbers(result.belief), result.healthy, odd, *even, root]
    said = [result.innovation, torch.as_tensor(result.count), result.healthy, result.nis, result.log_likelihood]
    said += [result.innovation_covariance, *([] if result.weight is None else [result.weight])]
    return [*_numbers(result.belief), *said]


if __name__ == "__main__":
    main()
