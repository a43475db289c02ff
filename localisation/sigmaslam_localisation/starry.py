"""Recordings in the form of "Starry Night" (Barfoot): a MATLAB file of a stereo camera above points at known places."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from sigmaslam.errors import InputError
from sigmaslam_filters import SO3
from sigmaslam_localisation.steps import Steps, since_before, slots
from sigmaslam_localisation.stereo_points import StereoRig
from sigmaslam_localisation.tubes import read_mat

VARIABLES = ("t", "w_vk_vk_i", "v_vk_vk_i", "rho_i_pj_i", "y_k_j", "C_c_v", "rho_v_c_v", "fu", "fv", "cu", "cv", "b")


@dataclass(frozen=True, slots=True, eq=False)
class StereoRecording:
    """What a body with a stereo camera recorded.

    Attributes:
        name: of the recording.
        steps: its motions and the points that it saw.
        rig: its camera.
        points: (M, 3) in the world, metres.
        truth: (K + 1, 7) translation and quaternion x, y, z, w of the body in the world, or None.
    """

    name: str
    steps: Steps
    rig: StereoRig
    points: np.ndarray
    truth: np.ndarray | None


def read_starry(path: Path) -> StereoRecording:
    """The recording in a .mat file.

    Raises:
        InputError: the file cannot be read, or misses a variable.
    """
    file = read_mat(path, VARIABLES)
    seconds = file["t"].ravel()
    if not (np.diff(seconds) > 0).all():
        raise InputError(f"{path}: the times t do not increase: sort its steps by time")
    duration = np.diff(seconds)
    rates = np.concatenate([file["v_vk_vk_i"], file["w_vk_vk_i"]]).T
    # Sampled at the frames: between them they are taken to change evenly.
    path_of_steps = 0.5 * (rates[:-1] + rates[1:]) * duration[:, None]
    pixels = file["y_k_j"].transpose(1, 2, 0)
    # Nothing is said of the first frame: the filter starts there.
    step, landmark = np.nonzero((pixels[1:, :, 0] >= 0).copy())
    slot = slots(step)
    shape = (len(duration), int(slot.max(initial=0)) + 1)
    value, index, since = np.full((*shape, 4), np.nan), np.zeros(shape, int), np.full(shape, np.inf)
    value[step, slot], index[step, slot] = pixels[1:][step, landmark], landmark
    since[step, slot] = since_before(seconds[1:][step], landmark)
    points = file["rho_i_pj_i"].T
    steps = Steps(
        np.array([len(duration)]),
        seconds[:, None],
        duration[:, None],
        path_of_steps[:, None],
        value[:, None],
        index[:, None],
        points[index][:, None],
        since[:, None],
    )
    fx, fy, cx, cy, baseline = (float(file[name].ravel()[0]) for name in ("fu", "fv", "cu", "cv", "b"))
    mounting = torch.from_numpy(file["C_c_v"]), torch.from_numpy(file["rho_v_c_v"].ravel())
    rig = StereoRig(fx, fy, cx, cy, baseline, *mounting)
    return StereoRecording(path.stem, steps, rig, points, _truth(file))


def _truth(file: dict[str, np.ndarray]) -> np.ndarray | None:
    """Poses (K, 7) of the body in the world; the file's axis-angle turns the world into the body, with a minus sign."""
    if not {"theta_vk_i", "r_i_vk_i"} <= file.keys():
        return None
    origin = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)
    # C = Exp(-psi) takes the world into the body, so Exp(psi) takes the body into the world.
    turn = SO3().retract(origin, torch.from_numpy(file["theta_vk_i"].T.copy())).numpy()
    return np.concatenate([file["r_i_vk_i"].T, turn], axis=1)
