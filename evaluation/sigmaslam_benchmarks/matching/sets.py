"""The sets by name: which choose models and data, and which are scored once."""

from collections.abc import Callable, Sequence
from pathlib import Path

from sigmaslam.errors import InputError
from sigmaslam_benchmarks.matching import photographs, sequence_pairs
from sigmaslam_benchmarks.matching.image_pairs import ImagePair, Motion
from sigmaslam_benchmarks.matching.stereo import StereoStep

SELECTION = ("set12", "middlebury")
"""Models and training data are chosen on these."""
FINAL = ("boat", "churchill", "fountain", "kitti", "euroc")
"""These are scored once, when everything is chosen."""
TRACKS, STEPS = "kitti_tracks", "euroc_steps"
"""The last two again: matches from frame to frame of up to 2,048 keypoints, and poses of steps between keyframes."""
ALL = (*SELECTION, *FINAL, TRACKS, STEPS)
REFINED = (*SELECTION, "boat", "churchill", "fountain", STEPS)
"""On these the matches of `sigmaslam match` are scored too."""

_SETS: dict[str, tuple[str, Callable[[Path], list[ImagePair]]]] = {
    "set12": ("denoising", photographs.set12),
    "middlebury": ("disparity_middlebury", photographs.middlebury),
    "boat": ("homography_boat", photographs.boat),
    "churchill": ("homography_hpatches_churchill", photographs.churchill),
    "fountain": ("strecha_fountain_P11", photographs.fountain),
    "kitti": ("kitti_raw_0926_0039_a", sequence_pairs.kitti),
    "euroc": ("euroc_v1_01_keyframes_a", sequence_pairs.euroc),
}


def check_sets(names: Sequence[str], data: Path) -> None:
    """Refuses sets that are unknown or not there, before long work starts.

    Args:
        names: of ALL.
        data: folder of the real data sets.
    Raises:
        InputError: names the first of them.
    """
    for name in names:
        if name not in ALL:
            raise InputError(f"there is no set '{name}': choose among {', '.join(ALL)}")
        _folder(data, _SETS[name.split("_")[0]][0])


def load_set(name: str, data: Path) -> list[ImagePair]:
    """The image pairs of a set.

    Args:
        name: one of SELECTION and FINAL.
        data: folder of the real data sets.
    Raises:
        InputError: there is no set of that name, or `data` does not hold it.
    """
    if name not in _SETS:
        raise InputError(f"there is no set '{name}': choose among {', '.join(_SETS)}")
    folder_name, load = _SETS[name]
    return load(_folder(data, folder_name))


def load_tracks(data: Path) -> list[ImagePair]:
    """The temporal pairs of the set kitti."""
    return [pair for pair in load_set("kitti", data) if isinstance(pair.truth, Motion)]


def load_steps(data: Path) -> list[StereoStep]:
    """The steps between keyframes of the set euroc."""
    return sequence_pairs.euroc_steps(_folder(data, _SETS["euroc"][0]))


def load_advances(data: Path, gap: int) -> list[StereoStep]:
    """From every sixth frame of the set kitti to the one so many frames later."""
    return sequence_pairs.kitti_steps(_folder(data, _SETS["kitti"][0]), gap)


def _folder(data: Path, name: str) -> Path:
    if not (data / name).is_dir():
        raise InputError(f"{data} does not hold {name}: set SIGMASLAM_DATA to the folder of the real data sets")
    return data / name
