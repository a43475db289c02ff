"""Headers in C++ do what the filters do, in a program that knows nothing else."""

import os
import shutil
import subprocess

import pytest
import torch

import sigmaslam_filters as filters
from sigmaslam_filters import systems
from tests.support.filter_builders import random_numbers

PROGRAM = """#include "robot.hpp"
#include <cstdio>
int main() {
    using robot::Number;
    Number mean[3], held[9], twist[3], value[4], landmark[4];
    auto read = [](Number* into, int count) {
        for (int k = 0; k < count; ++k) { double x; if (std::scanf("%lf", &x) != 1) return false; into[k] = (Number)x; }
        return true;
    };
    if (!read(mean, 3) || !read(held, 9)) return 1;
    while (read(twist, 3) && read(value, 4) && read(landmark, 4)) {
        const bool moved = robot::predict(mean, held, twist);
        const robot::Update seen = robot::update(mean, held, value, landmark);
        for (Number x : mean) std::printf("%.17g ", (double)x);
        for (Number x : held) std::printf("%.17g ", (double)x);
        std::printf("%.17g %.17g %d %d\\n", (double)seen.log_likelihood, (double)seen.nis, (int)seen.count,
                    (int)(moved && seen.healthy));
    }
}
"""


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize("make", [filters.UnscentedKalmanFilter, filters.ExtendedKalmanFilter])
def test_a_program_with_the_header_follows_a_robot_as_torch_does(make, dtype, tmp_path):
    """Two landmarks, of which components are missing, an outlier that the gate weakens, and no step of it on a heap."""
    compiler = shutil.which(os.environ.get("CXX", "g++"))
    if compiler is None:
        pytest.skip("no C++ compiler")
    pose = filters.SE2("right")
    bayes = make(pose, iterations=1)
    drive = filters.MotionModel(pose.retract, filters.Diagonal(torch.tensor([0.01, 0.01, 0.001], dtype=dtype) ** 2))
    see = systems.range_and_bearing(filters.Diagonal(torch.tensor([0.1, 0.02], dtype=dtype) ** 2))
    prior = filters.Gaussian(torch.tensor([0.0, 0.0, 3.1], dtype=dtype), 0.1 * torch.eye(3, dtype=dtype))
    landmarks = torch.tensor([[-3.0, 1.0], [-1.5, -1.5]], dtype=dtype)
    twist = torch.tensor([0.1, 0.0, 0.05], dtype=dtype)
    truth, values = prior.mean, []
    for k in range(6):
        truth = pose.retract(truth, twist)
        noise = torch.tensor([0.1, 0.02], dtype=dtype) * random_numbers(2, 2, seed=k).to(dtype)
        values.append(see.function(truth, landmarks) + noise)
    values[2][0, 1], values[3][:], values[4][1, 0] = torch.nan, torch.nan, 40.0
    example = filters.StepExample(prior, values[0], {"twist": twist}, {"landmark": landmarks})
    tolerance = 1e-12 if dtype == torch.float64 else 1e-4
    assert filters.export_step(bayes, drive, see, example, tmp_path / "robot.hpp", gate=0.999) < tolerance
    text = (tmp_path / "robot.hpp").read_text()
    assert {line for line in text.splitlines() if line.startswith("#")} == {
        "#pragma once", "#include <cmath>", "#include <cstdint>",
        "#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__", "#endif",
        '#error "NaN is a missing value: compile without -ffast-math, or with -fno-finite-math-only after it"',
    }  # fmt: skip
    assert not {"new ", "malloc", "std::vector"} & {word for word in ("new ", "malloc", "std::vector") if word in text}
    (tmp_path / "main.cpp").write_text(PROGRAM)
    flags = ["-std=c++17", "-O1", "-Wall", "-Werror", "-Wno-unused-variable", "-o", "robot"]
    subprocess.run([compiler, *flags, "main.cpp"], cwd=tmp_path, check=True, timeout=600)
    # Where NaN is assumed not to be, a missing value would be a number.
    refused = subprocess.run(
        [compiler, *flags, "-ffast-math", "main.cpp"], cwd=tmp_path, capture_output=True, text=True
    )
    assert refused.returncode
    assert "NaN is a missing value" in refused.stderr
    by_root = dtype == torch.float32
    belief = filters.Gaussian(prior.mean, factor=prior.factor, factor_is_lower=True) if by_root else prior
    numbers = [*belief.mean.tolist(), *belief.held.flatten().tolist()]
    expected = []
    for value in values:
        numbers += [*twist.tolist(), *value.flatten().tolist(), *landmarks.flatten().tolist()]
        moved = bayes.predict(belief, drive, twist)
        seen = bayes.update(moved.belief, filters.several(see, 2), value.flatten(), landmarks, gate=0.999)
        belief = seen.belief
        said = [float(seen.log_likelihood), float(seen.nis), float(seen.count), 1.0]
        expected.append([*belief.mean.tolist(), *belief.held.flatten().tolist(), *said])
    done = subprocess.run(
        [tmp_path / "robot"], input=" ".join(map(repr, numbers)), capture_output=True, text=True, check=True, timeout=60
    )
    found = [[float(word) for word in line.split()] for line in done.stdout.splitlines()]
    torch.testing.assert_close(
        torch.tensor(found).double(), torch.tensor(expected).double(), rtol=0, atol=100 * tolerance
    )
    # One landmark of two is no minority: it is weakened, not refused.
    assert [row[-2] for row in expected] == [4, 4, 3, 0, 4, 4]


@pytest.mark.parametrize("name", ["two-words.hpp", "double.hpp", "1st.hpp", "union.hpp", "NAN.hpp"])
def test_a_name_that_is_none_in_cpp_is_refused(name, tmp_path):
    see = filters.LinearMeasurement(torch.eye(2).double(), torch.eye(2).double())
    example = filters.StepExample(
        filters.Gaussian(torch.zeros(2).double(), torch.eye(2).double()), torch.zeros(2).double()
    )
    with pytest.raises(filters.ExportError, match="cannot name anything in C"):
        filters.export_step(filters.KalmanFilter(), None, see, example, tmp_path / name)
    with pytest.raises(ValueError, match=r"ends in \.onnx or \.hpp"):
        filters.export_step(filters.KalmanFilter(), None, see, example, tmp_path / "robot.h")
    assert not list(tmp_path.iterdir())
