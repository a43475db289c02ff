"""A thousand targets at once, each by an IMM of a calm and a wild motion. `python examples/filters/many_targets.py`."""

from typing import Any

import torch

from sigmaslam_filters import Gaussian, InteractingMultipleModels, KalmanFilter, LinearMeasurement, LinearMotion
from sigmaslam_filters.systems import constant_velocity_over

DOUBLE, TARGETS, STEPS = torch.float64, 1000, 60


def run(axes: Any = None) -> dict[str, float]:
    """Targets drive straight but for steps 20 to 40, in which they accelerate."""
    generator, dt = torch.Generator().manual_seed(6), 0.5
    calm = constant_velocity_over(torch.tensor([1e-3, 1e-3], dtype=DOUBLE), dt)
    wild = LinearMotion(calm.matrix, 1e3 * calm.noise)
    see = LinearMeasurement(torch.eye(2, 4, dtype=DOUBLE), torch.eye(2, dtype=DOUBLE))
    truth = 10.0 * torch.randn(TARGETS, 4, generator=generator, dtype=DOUBLE)
    start = Gaussian(truth, torch.eye(4, dtype=DOUBLE).expand(TARGETS, 4, 4))
    kf, turn = KalmanFilter(), torch.tensor([[0.97, 0.03], [0.03, 0.97]], dtype=DOUBLE)
    imm = InteractingMultipleModels(kf, [calm, wild], turn)
    mixture, alone, errors, manoeuvring = imm.start(start), {"calm": start, "wild": start}, {}, []
    for step in range(STEPS):
        motion = wild if 20 <= step < 40 else calm
        root = torch.linalg.cholesky(motion.noise)
        truth = truth @ motion.matrix.mT + torch.randn(TARGETS, 4, generator=generator, dtype=DOUBLE) @ root.mT
        value = truth[:, :2] + torch.randn(TARGETS, 2, generator=generator, dtype=DOUBLE)
        mixture = imm.update(imm.predict(mixture), see, value)
        for name, one in (("calm", calm), ("wild", wild)):
            alone[name] = kf.update(kf.predict(alone[name], one).belief, see, value).belief
        for name, belief in {"IMM": imm.gaussian(mixture), **alone}.items():
            errors.setdefault(name, []).append((belief.mean - truth)[:, :2].square().sum(-1).mean().sqrt())
        manoeuvring.append(mixture.probability[..., 1].mean())
    if axes is not None:
        for name, each in errors.items():
            axes.plot(torch.stack(each), label=f"{name}, rms [m]")
        axes.plot(torch.stack(manoeuvring), "--", label="probability of wild")
        axes.set_ylim(0, 4)
        axes.legend()
    return {f"rms, {name} [m]": float(torch.stack(each).square().mean().sqrt()) for name, each in errors.items()}


if __name__ == "__main__":
    print(run())
