"""Which kind of recording a path is, and its robots."""

from pathlib import Path

from sigmaslam.errors import InputError
from sigmaslam_localisation.csv_folder import read_csv_folder
from sigmaslam_localisation.mrclam import find_robots, read_mrclam
from sigmaslam_localisation.recording import Recording
from sigmaslam_localisation.tubes import read_mat, read_tubes


def detect_format(path: Path) -> str:
    """The format by its name.

    Raises:
        InputError: it is none that is known.
    """
    if path.is_dir():
        if (path / "sightings.csv").is_file() or (path / "landmarks.csv").is_file():
            return "csv"
        if find_robots(path):
            return "mrclam"
    elif path.suffix == ".mat" and path.is_file():
        return "starry" if "y_k_j" in read_mat(path, ()) else "tubes"
    raise InputError(
        f"{path}: is no recording that is known: give a folder with Robot1_Measurement.dat or with landmarks.csv,"
        " or a .mat file of tubes or stereo points"
    )


def read_recordings(
    path: Path, kind: str, robot: int | None, mapping: bool = False, associated: bool = True
) -> list[Recording]:
    """The recordings of a path of wheeled robots: of one robot, or of all.

    For mapping, landmarks need no places; sightings need no landmarks if these are not yet `associated`.

    Raises:
        InputError: a file is wrong, or there is no such robot.
    """
    if kind == "mrclam":
        robots = find_robots(path)
        if not robots:
            raise InputError(f"{path}: has no Robot1_Measurement.dat, or of another number: give --format")
        if robot is not None and robot not in robots:
            raise InputError(f"{path}: has no robot {robot}: choose --robot {', '.join(map(str, robots))}")
        return [read_mrclam(path, number) for number in ([robot] if robot is not None else robots)]
    if robot is not None:
        raise InputError(f"{path}: a recording of this format has one robot: leave out --robot")
    return [read_tubes(path) if kind == "tubes" else read_csv_folder(path, mapping, associated)]
