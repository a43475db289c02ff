"""EuRoC's ASL folders, and the flat form with both cameras' images in one folder."""

import csv
from pathlib import Path

from sigmaslam.bounded_files import TABLE_BYTES, read_text, shorten
from sigmaslam.calibration_files.calibration import find_calibration, read_calibration
from sigmaslam.calibration_files.euroc_calibration import read_sensors
from sigmaslam.errors import InputError
from sigmaslam.readers.images import ImagePairs
from sigmaslam.readers.kitti import common_size
from sigmaslam.readers.pairing import list_images, pair_by_stamp, stamped_images
from sigmaslam.readers.stereo_sequence import StereoSequence

LOOKED_FOR = (
    "(also TUM-VI) folders cam0/data + cam1/data or mav0/cam0/data + mav0/cam1/data, or images/<ns>_0.* and <ns>_1.* "
    "with cam0_sensor.yaml"
)


def find_asl_root(folder: Path) -> Path | None:
    """The folder that has cam0/data and cam1/data, if there is one."""
    roots = (folder, folder / "mav0")
    return next((each for each in roots if all((each / eye / "data").is_dir() for eye in ("cam0", "cam1"))), None)


def is_flat(folder: Path) -> bool:
    """Whether this is the flat form."""
    return (folder / "images").is_dir() and (folder / "cam0_sensor.yaml").is_file()


def open_euroc(folder: Path, calibration: Path | None = None) -> StereoSequence:
    """Open a EuRoC (ASL) or TUM-VI folder: images paired by time stamp, two sensor.yaml or dso/camchain.yaml.

    Raises:
        InputError: the layout is not EuRoC's, or the left and right images differ by more than 10 %.
        CalibrationError: a sensor.yaml is missing or wrong.
    """
    root = find_asl_root(folder)
    if root is not None:
        left, right = (_asl_images(root / camera) for camera in ("cam0", "cam1"))
        sensors = [root / camera / "sensor.yaml" for camera in ("cam0", "cam1")]
    elif is_flat(folder):
        left, right = (_flat_images(folder / "images", eye) for eye in (0, 1))
        sensors = [folder / f"{camera}_sensor.yaml" for camera in ("cam0", "cam1")]
    else:
        raise InputError(f"{folder}: not a EuRoC folder; looked for {LOOKED_FOR}")
    files, timestamps = pair_by_stamp(left, right, folder)
    pairs = ImagePairs(files, timestamps, folder)
    # TUM-VI has no sensor.yaml, and a camchain.yaml in a folder beside.
    if calibration is None and not any(sensor.exists() for sensor in sensors):
        calibration = find_calibration(folder)
    if calibration is None:
        camera = read_sensors(sensors[0], sensors[1])
    else:
        camera = read_calibration(calibration, common_size(pairs.first_pair))
    return StereoSequence(pairs, camera, folder, "euroc")


def _asl_images(camera: Path) -> dict[int, Path]:
    """Images of a camera by time stamp: the file name, or what data.csv says for that name."""
    stamped, files, table = stamped_images(camera / "data"), list_images(camera / "data"), camera / "data.csv"
    # Shorter names than of nanoseconds are rounded.
    if stamped is not None and not (table.is_file() and any(len(path.stem) < 16 for path in files)):
        return stamped
    try:
        lines = read_text(table, TABLE_BYTES, "the time stamps").splitlines()
        rows = [row for row in csv.reader(lines) if len(row) >= 2 and not row[0].startswith("#")]
        stamps = {row[1].strip(): int(row[0]) for row in rows}
    except (InputError, ValueError, csv.Error) as error:
        raise InputError(
            f"{camera / 'data'}: names are no time stamps (such as {files[0].name}) and {table} cannot be used: "
            f"{shorten(str(error), 300)}"
        ) from None
    missing = [path.name for path in files if path.name not in stamps]
    if missing:
        raise InputError(f"{table}: no time stamp for {len(missing)} images, the first is {missing[0]}")
    return {stamps[path.name]: path for path in files}


def _flat_images(folder: Path, eye: int) -> dict[int, Path]:
    ending = f"_{eye}"
    files = [path for path in list_images(folder) if path.stem.endswith(ending)]
    stamps = {path.stem.removesuffix(ending): path for path in files}
    if not files or not all(stem.isdecimal() for stem in stamps):
        raise InputError(f"{folder}: expected images <nanoseconds>{ending}.*")
    return {int(stem): path for stem, path in stamps.items()}
