"""Views and sigma points of the estimator's graphs as C++ from the same modules: `sigmaslam/estimation/views.inc`.

A view is traced with two poses alone, those that its landmark is anchored to and that see it, so the state has 27
numbers: of the calibration and of both poses. `estimator.cpp` puts them where they belong in the whole state.
"""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from release.item_source import write_functions
from sigmaslam.estimation.chi_square import CHI_SQUARE_999, CHI_SQUARE_MEDIAN
from sigmaslam.estimation.state_layout import CALIBRATION_SIZE, LANDMARK_SIZE
from sigmaslam_filters.manifolds.se3_matrices import exp_se3, invert_se3, log_se3
from sigmaslam_models.estimator.frame_update import NOISE_SCALE_RULES, ROBUST_SCALES, FrameViews, linearised, predicted
from sigmaslam_models.estimator.inertial_prediction import STATE_SIZE as INERTIAL_SIZE
from sigmaslam_models.estimator.inertial_prediction import moved_by_sensor, sensor_noise
from sigmaslam_models.estimator.pose_prediction import moved_state, process_noise
from sigmaslam_models.estimator.window_solution import WindowViews, agreeing, whitened

SIZE = CALIBRATION_SIZE + 12
_HEAD = "// Made by release.view_source; do not edit.\n\n"


def write_views() -> str:
    """The whole file."""
    constants: dict[str, Sequence[float]] = {
        "CHI_SQUARE_MEDIAN": CHI_SQUARE_MEDIAN[2:4].tolist(),
        "CHI_SQUARE_999": CHI_SQUARE_999[2:4].tolist(),
        "ROBUST_SCALES": ROBUST_SCALES,
        "NOISE_SCALE_RULES": NOISE_SCALE_RULES,
    }
    return _HEAD + "\n".join(
        [
            *(
                f"constexpr double {name}[] = {{{', '.join(str(value) for value in each)}}};"
                for name, each in constants.items()
            ),
            write_functions("predict", _predicted_view, _numbers(_FRAME), _numbers(_OWN)),
            write_functions("frame", _linearised_view, _numbers(_FRAME), _numbers((*_OWN, "moved", *_SEEN))),
            write_functions("moved", _moved_pose, _numbers(_MOTION), _numbers(("state",))),
            write_functions("arrive", _arrived, _numbers((*_MOTION, "densities", "mean")), {}),
            write_functions("sensed", _sensed_pose, _numbers(_SENSED), _numbers(("point",))),
            write_functions("settle", _settled, _numbers((*_SENSED, *_SETTLED)), {}),
            write_functions("window", _window_view, _numbers((*_WINDOW, "freedom")), _numbers((*_OWN, *_SEEN))),
        ]
    )


_WINDOW = ("intrinsics", "depth", "unscented", "poses", "calibration", "spread")
_FRAME = (*_WINDOW, "offset")
_OWN = ("estimate", "covariance", "common")
_SEEN = ("measurement", "noise")
_MOTION = ("pose", "twist", "step")
_SENSED = ("pose", "velocity", "gravity", "mounting", "step", "turn", "gained", "moved_by", "slope")
_SETTLED = ("covered", "walk", "change")
_SHAPES: dict[str, tuple[int, ...]] = {
    **{"intrinsics": (5,), "depth": (), "unscented": (), "freedom": (), "poses": (2, 4, 4)},
    **{"calibration": (CALIBRATION_SIZE,), "spread": (SIZE, SIZE), "offset": (SIZE,), "common": (3, 2)},
    **{"estimate": (LANDMARK_SIZE,), "covariance": (LANDMARK_SIZE, LANDMARK_SIZE), "moved": (LANDMARK_SIZE,)},
    **{"measurement": (3,), "noise": (3, 3), "pose": (4, 4), "twist": (6,), "step": (), "state": (12,)},
    **{"densities": (2,), "mean": (6,), "mounting": (4, 4), "turn": (3, 3), "slope": (9, 25), "covered": (9, 9)},
    **{"walk": (2,), "change": (9,), "point": (INERTIAL_SIZE,)},
    **dict.fromkeys(("velocity", "gravity", "gained", "moved_by"), (3,)),
}


def _numbers(names: tuple[str, ...]) -> dict[str, Tensor]:
    return {name: torch.ones(_SHAPES[name], dtype=torch.float64) for name in names}


def _frame(window: Sequence[Tensor], own: Sequence[Tensor]) -> FrameViews:
    """A frame with one view, whose landmark does not depend on the state: how it does is the caller's."""
    intrinsics, depth, unscented, poses, calibration = window
    estimate, covariance, common = own
    anchor = torch.zeros(1, dtype=torch.int64)
    scene = (intrinsics, depth, unscented, anchor, anchor + 1, anchor, common[None], covariance[None])
    still = torch.zeros(1, LANDMARK_SIZE, SIZE, dtype=torch.float64)
    return FrameViews(*scene, estimate[None], still, poses, calibration, torch.zeros(SIZE, 1, dtype=torch.float64))


def _predicted_view(*given: Tensor) -> tuple[Tensor, ...]:
    spread, offset = given[5:7]
    return predicted(_frame(given[:5], given[7:10]), offset, spread)


def _linearised_view(*given: Tensor) -> tuple[Tensor, ...]:
    spread, offset, moved, measurement, noise = *given[5:7], *given[10:]
    frame = _frame(given[:5], given[7:10])
    seen = linearised(frame, measurement[None], noise[None], offset, spread, moved[None])
    return seen.by_state, seen.by_landmark, seen.residual, seen.squared, seen.components, seen.usable.to(noise.dtype)


def _window_view(*given: Tensor) -> tuple[Tensor, ...]:
    intrinsics, depth, unscented, poses, calibration, spread, freedom, *own = given
    estimate, covariance, common, measurement, noise = (each[None] for each in own)
    anchor = torch.zeros(1, dtype=torch.int64)
    scene = (intrinsics, depth, unscented, anchor, anchor + 1, anchor, common)
    window = WindowViews(*scene, anchor, estimate, covariance, poses, calibration, spread, measurement, noise)
    return *whitened(window, freedom), agreeing(window).to(torch.float64)


def _moved_pose(pose: Tensor, twist: Tensor, step: Tensor, state: Tensor) -> tuple[Tensor, ...]:
    back = invert_se3(pose @ exp_se3(twist * step))
    return (moved_state(pose, twist, step, back, state[None])[:, :6],)


def _arrived(pose: Tensor, twist: Tensor, step: Tensor, densities: Tensor, mean: Tensor) -> tuple[Tensor, ...]:
    predicted = pose @ exp_se3(twist * step)
    return exp_se3(mean) @ predicted, process_noise(predicted, step, densities)


def _sensed_pose(*given: Tensor) -> tuple[Tensor, ...]:
    motion, point = given[:9], given[9][None]
    camera, velocity, _ = moved_by_sensor(motion, point)
    predicted, speed, _ = moved_by_sensor(motion, torch.zeros_like(point))
    return log_se3(camera @ invert_se3(predicted)), velocity - speed


def _settled(*given: Tensor) -> tuple[Tensor, ...]:
    motion, noise, walk, change = given[:9], *given[9:]
    camera, velocity, body = moved_by_sensor(motion, torch.zeros(1, INERTIAL_SIZE, dtype=torch.float64))
    start = motion[0] @ motion[3]
    added = sensor_noise(start[:3, :3], body[0], noise, walk * motion[4])
    return exp_se3(change[:6]) @ camera[0], velocity[0] + change[6:], added


if __name__ == "__main__":
    import sigmaslam.estimation

    (Path(sigmaslam.estimation.__file__).parent / "views.inc").write_text(write_views())
