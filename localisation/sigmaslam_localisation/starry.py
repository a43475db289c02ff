"""Recordings in the form of "Starry Night" (Barfoot): a MATLAB file of a stereo camera above points at known places."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from sigmaslam.errors import InputError
from sigmaslam_filters import SO3
from sigmaslam_localisation.steps import Steps, in_slots
from sigmaslam_localisation.stereo_points import StereoNoise, StereoRig
from sigmaslam_localisation.tubes import read_mat

VARIABLES = ("t", "w_vk_vk_i", "v_vk_vk_i", "rho_i_pj_i", "y_k_j", "C_c_v", "rho_v_c_v", "fu", "fv", "cu", "cv", "b")


@dataclass(frozen=True, slots=True, eq=False)
class StereoRecording:
    """What a body with a stereo camera recorded.

    Attributes:
        name: of the recording.
        seconds: (K + 1,) times of its frames.
        rates: (K + 1, 6) speeds and turn rates of the body in its own frame, m/s, rad/s.
        pixels: (K + 1, M, 4) columns and rows of the points on the left, then on the right; negative for none.
        points: (M, 3) in the world, metres.
        truth: (K + 1, 7) translation and quaternion x, y, z, w of the body in the world, or None.
    """

    name: str
    seconds: np.ndarray
    rates: np.ndarray
    pixels: np.ndarray
    rig: StereoRig
    points: np.ndarray
    truth: np.ndarray | None

    def steps(self, delays: Sequence[float]) -> Steps:
        """Motions and the points that were seen, side by side for delays of the gyroscopes, in seconds.

        A step's path (12) is the way and the turn, metres and radians, then by how much each were more if the body had
        moved as at its end and not as at its start. Nothing is said of the first frame: the filter starts there.
        """
        path = np.stack([self._path(delay) for delay in delays], axis=1)
        step, landmark = np.nonzero(self.pixels[1:, :, 0] >= 0)
        pixels = self.pixels[1:][step, landmark]
        value, index, since = in_slots(len(path), step, self.seconds[1:][step], landmark, pixels)
        count = len(delays)
        seconds, durations, values, indices, positions, times = (
            np.repeat(column[:, None], count, axis=1)
            for column in (self.seconds, np.diff(self.seconds), value, index, self.points[index], since)
        )
        steps = np.full(count, len(path))
        return Steps(steps, seconds, durations, path, values, indices, positions, times, StereoNoise().correlation)

    def _path(self, delay: float) -> np.ndarray:
        """(K, 12) by integration of rates that change evenly between their samples."""
        way, of_way = _integrated(self.seconds, self.rates[:, :3], self.seconds)
        turn, of_turn = _integrated(self.seconds, self.rates[:, 3:], self.seconds + delay)
        return np.concatenate([way, turn, of_way, of_turn], axis=1)


def _integrated(seconds: np.ndarray, rates: np.ndarray, knots: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Integrals (K, 3) of sampled rates (S, 3) between knots (K + 1,), and the rates' changes times the duration."""
    times = np.union1d(seconds, knots)
    between = np.stack([np.interp(times, seconds, rate) for rate in rates.T], axis=1)
    area = np.vstack([np.zeros(3), np.cumsum(0.5 * (between[:-1] + between[1:]) * np.diff(times)[:, None], axis=0)])
    index = np.searchsorted(times, knots)
    return np.diff(area[index], axis=0), np.diff(between[index], axis=0) * np.diff(knots)[:, None]


def read_starry(path: Path) -> StereoRecording:
    """The recording in a .mat file.

    Raises:
        InputError: the file cannot be read, or misses a variable.
    """
    file = read_mat(path, VARIABLES)
    seconds = file["t"].ravel()
    if not (np.diff(seconds) > 0).all():
        raise InputError(f"{path}: the times t do not increase: sort its steps by time")
    rates = np.concatenate([file["v_vk_vk_i"], file["w_vk_vk_i"]]).T
    fx, fy, cx, cy, baseline = (float(file[name].ravel()[0]) for name in ("fu", "fv", "cu", "cv", "b"))
    mounting = torch.from_numpy(file["C_c_v"]), torch.from_numpy(file["rho_v_c_v"].ravel())
    rig = StereoRig(fx, fy, cx, cy, baseline, *mounting)
    pixels = file["y_k_j"].transpose(1, 2, 0).copy()
    return StereoRecording(path.stem, seconds, rates, pixels, rig, file["rho_i_pj_i"].T, _truth(file))


def _truth(file: dict[str, np.ndarray]) -> np.ndarray | None:
    """Poses (K, 7) of the body in the world; the file's axis-angle turns the world into the body, with a minus sign."""
    if not {"theta_vk_i", "r_i_vk_i"} <= file.keys():
        return None
    origin = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)
    # C = Exp(-psi) takes the world into the body, so Exp(psi) takes the body into the world.
    turn = SO3().retract(origin, torch.from_numpy(file["theta_vk_i"].T.copy())).numpy()
    return np.concatenate([file["r_i_vk_i"].T, turn], axis=1)
