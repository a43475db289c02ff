"""Files that grow while a run goes on."""

import shutil
from pathlib import Path

import pytest

from sigmaslam.errors import OutputError
from sigmaslam.run_record.appended_file import AppendedFile, is_in_use


@pytest.mark.parametrize("goes_on", [False, True])
def test_a_file_that_is_removed_with_its_folder_is_made_again_whole(tmp_path: Path, goes_on: bool):
    path = tmp_path / "run" / "poses"
    path.parent.mkdir()
    if goes_on:
        path.write_bytes(b"zero ")
    file = AppendedFile(path, goes_on)
    file.append(b"one ")
    shutil.rmtree(path.parent)
    file.append(b"two ")
    assert is_in_use(path)
    shutil.rmtree(path.parent)
    file.close()
    assert path.read_bytes() == b"zero " * goes_on + b"one two "


def test_a_removed_file_that_cannot_be_made_again_is_named(tmp_path: Path):
    path = tmp_path / "run" / "poses"
    path.parent.mkdir()
    file = AppendedFile(path)
    shutil.rmtree(path.parent)
    path.parent.touch()
    with pytest.raises(OutputError, match=r"poses: was removed while the run goes on, and cannot be made again"):
        file.append(b"one")
