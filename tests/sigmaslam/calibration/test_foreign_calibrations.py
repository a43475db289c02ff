"""Calibrations written for other programs and read back."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.calibration_files.calibration import read_calibration
from sigmaslam.calibration_files.foreign_calibrations import FORMS, write_foreign_calibration
from sigmaslam.errors import CalibrationError, InputError
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from tests.support.calibration_forms import SIZE, assert_same_rig, raw_rig, rectified_rig
from tests.support.commands import assert_refused, run_here

NAMES = {"ros": "folder", "euroc": "folder", "kitti": "calib.txt"}
FEWER = ("kalibr", "euroc")
"""Forms of four coefficients."""


def written(folder: Path, rig: StereoCamera, form: str) -> StereoCamera:
    out = folder / NAMES.get(form, "calibration.yaml")
    write_foreign_calibration(out, rig, form)
    return read_calibration(out, SIZE)


def with_coefficients(rig: StereoCamera, count: int) -> StereoCamera:
    """Radial-tangential with so many coefficients."""

    def changed(eye: CameraModel) -> CameraModel:
        values = (*eye.distortion, 0.021, -0.013, 0.004)[:count]
        return replace(eye, distortion_model="radtan", distortion=values)

    return replace(rig, left=changed(rig.left), right=changed(rig.right))


def assert_same_rays(read: StereoCamera, rig: StereoCamera) -> None:
    grid = np.stack(np.meshgrid(np.linspace(0.0, SIZE[0] - 1.0, 9), np.linspace(0.0, SIZE[1] - 1.0, 7)), axis=-1)
    for one, other in ((read.left, rig.left), (read.right, rig.right)):
        np.testing.assert_allclose(one.unproject(grid), other.unproject(grid), rtol=0, atol=1e-9)


@pytest.mark.parametrize("form", sorted(FORMS.keys() - {"kitti"}))
@pytest.mark.parametrize("lens", ["equidistant", "radtan4", "radtan5", "radtan8"])
def test_a_raw_pair_is_read_back(tmp_path: Path, form: str, lens: str):
    rig = raw_rig("equidistant") if lens == "equidistant" else with_coefficients(raw_rig("radtan"), int(lens[-1]))
    if (lens[-1] in "58" and form in FEWER) or (lens == "radtan8" and form == "orb-slam"):
        with pytest.raises(CalibrationError, match=f"the form {form} has . coefficients of a lens"):
            written(tmp_path, rig, form)
        assert not list(tmp_path.iterdir())
        return
    read = written(tmp_path, rig, form)
    assert_same_rig(read, rig)
    assert_same_rays(read, rig)


@pytest.mark.parametrize("form", FORMS)
def test_a_rectified_pair_is_read_back(tmp_path: Path, form: str):
    read = written(tmp_path, rectified_rig(), form)
    assert_same_rig(read, rectified_rig())
    assert_same_rays(read, rectified_rig())


@pytest.mark.parametrize("form", ["opencv", "orb-slam"])
def test_opencv_reads_its_own_form(tmp_path: Path, form: str):
    rig = raw_rig("radtan")
    write_foreign_calibration(tmp_path / "stereo.yaml", rig, form)
    storage = cv2.FileStorage(str(tmp_path / "stereo.yaml"), cv2.FILE_STORAGE_READ)
    if form == "orb-slam":
        assert storage.getNode("Camera.type").string() == "PinHole"
        assert storage.getNode("Camera2.fx").real() == rig.right.fx
        np.testing.assert_array_equal(storage.getNode("Stereo.T_c1_c2").mat(), rig.T_left_right.astype(float))
        return
    np.testing.assert_array_equal(storage.getNode("K2").mat(), rig.right.matrix)
    R, T = storage.getNode("R").mat(), storage.getNode("T").mat()
    point = np.array([0.3, -0.2, 2.0])
    np.testing.assert_allclose(rig.T_left_right[:3, :3] @ (R @ point + T[:, 0]) + rig.T_left_right[:3, 3], point)


def test_what_a_form_cannot_say_is_refused(tmp_path: Path):
    rig = raw_rig("radtan")
    with pytest.raises(CalibrationError, match=r"kitti .* is of rectified images, these are raw"):
        write_foreign_calibration(tmp_path / "calib.txt", rig, "kitti")
    skewed = replace(rectified_rig(), left=replace(rectified_rig().left, skew=0.5))
    for form in FORMS.keys() - {"own"}:
        with pytest.raises(CalibrationError, match=f"the form {form} has no skew"):
            write_foreign_calibration(tmp_path / NAMES.get(form, "a.yaml"), skewed, form)
    smaller = replace(rig, right=replace(rig.right, width=600))
    mixed = replace(rig, right=raw_rig("equidistant").right)
    for form in ("opencv", "orb-slam"):
        with pytest.raises(CalibrationError, match="one image size for both eyes"):
            write_foreign_calibration(tmp_path / "a.yaml", smaller, form)
        with pytest.raises(CalibrationError, match="one lens model for both eyes"):
            write_foreign_calibration(tmp_path / "a.yaml", mixed, form)
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match="choose the name of a folder"):
        write_foreign_calibration(tmp_path / "a.yaml", rig, "ros")


def test_two_eyes_of_other_lenses_and_sizes_are_read_back(tmp_path: Path):
    mixed = replace(raw_rig("radtan"), right=replace(raw_rig("equidistant").right, width=700))
    for form in ("ros", "own"):
        assert_same_rig(written(tmp_path, mixed, form), mixed)
    mixed = replace(mixed, left=with_coefficients(mixed, 4).left)
    for form in FEWER:
        assert_same_rig(
            written(tmp_path / form, mixed, form) if form == "euroc" else written(tmp_path, mixed, form), mixed
        )


def test_the_command_writes_what_it_is_asked_for(tmp_path: Path):
    source = tmp_path / "own.yaml"
    write_foreign_calibration(source, raw_rig("radtan"), "own")
    result = run_here("calibrate", "convert", source, tmp_path / "ros", "--to", "ros")
    assert result.returncode == 0, result.stderr
    assert_same_rig(read_calibration(tmp_path / "ros"), raw_rig("radtan"))
    assert_refused(run_here("calibrate", "convert", source, tmp_path / "k.yaml", "--to", "kalibr"), "4 coefficients")
    assert_refused(run_here("calibrate", "convert", source, tmp_path / "k.txt", "--to", "kalibr"), "ends in .yaml")
