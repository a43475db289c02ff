"""Which images are a pair, by the names of files and folders."""

from pathlib import Path

import pytest

from sigmaslam.calibration.board_images import find_board_images
from sigmaslam.errors import InputError


def written(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("stereoLeft/imageL{}.png", "stereoRight/imageR{}.png"),
        ("stereoLeft/{}.png", "stereoRight/{}.png"),
        ("LEFT_eye/board{}.png", "RIGHT_eye/shot{}.png"),
        ("one/imageL{}.png", "other/imageR{}.png"),
        ("left/{}.png", "right/{}.png"),
        ("cam0/data/{}.png", "cam1/data/{}.png"),
        ("image_0/{}.png", "image_1/{}.png"),
        ("image_02/data/{}.png", "image_03/data/{}.png"),
        ("camera-1/{}.png", "camera-2/{}.png"),
        ("L/{}.png", "R/{}.png"),
        ("board_L/{}.png", "board_R/{}.png"),
        ("imgL/{}.png", "imgR/{}.png"),
        ("one/l_{}.png", "other/r_{}.png"),
        ("one/{}_L.png", "other/{}_R.png"),
        ("one/{}-right_cam0.png", "other/{}-right_cam1.png"),
        ("bright room/left/{}.png", "bright room/right/{}.png"),
    ],
)
def test_two_folders_of_two_eyes_are_pairs(tmp_path: Path, left: str, right: str):
    written(tmp_path, *(name.format(k) for name in (left, right) for k in ("1", "2", "10")))
    folders = [tmp_path / Path(name).parent for name in (left, right)]
    found = find_board_images(folders)
    expected = [tuple(tmp_path / name.format(k) for name in (left, right)) for k in ("1", "2", "10")]
    assert [moment.files for moment in found] == expected
    assert find_board_images([tmp_path]) == found


def test_recordings_in_folders_of_their_own_are_not_mixed(tmp_path: Path):
    names = [f"{day}/{eye}/{k}.png" for day in ("monday", "tuesday") for eye in ("left", "right") for k in (1, 2)]
    found = find_board_images([written(tmp_path, *names)])
    assert len(found) == 4
    assert all(left.parent.parent == right.parent.parent for left, right in (moment.files for moment in found))


def test_eyes_whose_images_do_not_pair_are_refused(tmp_path: Path):
    written(tmp_path, "left/1.png", "left/2.png", "right/3.png", "right/4.png")
    with pytest.raises(InputError, match="no image of the left eye has one of the right eye beside it"):
        find_board_images([tmp_path])


def test_an_image_beside_those_of_two_eyes_is_named(tmp_path: Path):
    """All of them made one camera of two, 3 sigmas from either."""
    written(tmp_path, *(f"{eye}/{k}.png" for eye in ("left", "right") for k in (1, 2)), "debug/drawn.png")
    with pytest.raises(InputError, match=r"debug/drawn\.png: its name tells no eye"):
        find_board_images([tmp_path])
    for name in ("img_{}", "cam{}"):  # of which 0 and 1 look like a pair
        series = written(tmp_path / name, *(f"{name}.png".format(k) for k in range(12)))
        assert [len(moment.files) for moment in find_board_images([series])] == [1] * 12


def test_two_folders_of_equal_length_whose_eyes_no_name_tells_are_refused(tmp_path: Path):
    written(tmp_path, "a/1.png", "a/2.png", "b/1.png", "b/2.png", "b2/1.png")
    with pytest.raises(InputError, match="2 and 2 images, and no name says which eye"):
        find_board_images([tmp_path / "a", tmp_path / "b"])
    with pytest.raises(InputError, match="2 and 1 images, and no name"):
        find_board_images([tmp_path / "a", tmp_path / "b2"])
    written(tmp_path, "c/3.png")
    assert [len(moment.files) for moment in find_board_images([tmp_path / "a", tmp_path / "c"])] == [1, 1, 1]


def test_a_letter_before_the_number_is_no_eye_where_there_is_but_one(tmp_path: Path):
    folder = written(tmp_path / "images", "cal1.png", "cal2.png")
    assert [len(moment.files) for moment in find_board_images([folder])] == [1, 1]
