"""A run is removed whole, and nothing else ever."""

from pathlib import Path

import pytest

from sigmaslam.errors import InputError
from sigmaslam.report.report import write_report
from sigmaslam.run_record.appended_file import AppendedFile
from sigmaslam.run_record.pose_file import PARTIAL_POSES
from sigmaslam.run_record.removal import remove_run
from tests.support.recorded_runs import make_run


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    make_run(folder, 12, points=10, pictures=True)
    write_report(folder)
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_run_is_removed_whole(run: Path):
    remove_run(run)
    assert not any(run.iterdir())


def test_what_a_killed_run_left_behind_is_removed_with_it(run: Path):
    (run / ".poses.0123456789ab.csv").write_text("cut off")
    remove_run(run)
    assert not any(run.iterdir())


def test_a_link_to_nothing_is_named(tmp_path: Path):
    (tmp_path / "out").symlink_to(tmp_path / "gone")
    with pytest.raises(InputError, match=r"out: is a link to .*gone, which is not there"):
        remove_run(tmp_path / "out")


def test_no_folder_or_an_empty_one_is_left_alone(tmp_path: Path):
    remove_run(tmp_path / "none")
    remove_run(tmp_path)
    assert tmp_path.is_dir()


@pytest.mark.parametrize("name", ["notes.txt", "image_0"])
def test_a_file_that_no_run_writes_saves_all(run: Path, name: str):
    (run / name).write_text("mine")
    before = contents(run)
    with pytest.raises(InputError, match=rf"holds {name}, which no run has written"):
        remove_run(run)
    assert contents(run) == before


def test_what_is_no_run_is_not_removed(run: Path):
    (run / "run.json").unlink()
    before = contents(run)
    with pytest.raises(InputError, match=r"holds no run\.json"):
        remove_run(run)
    assert contents(run) == before


def test_a_run_that_goes_on_is_not_removed(run: Path):
    writer = AppendedFile(run / PARTIAL_POSES)
    with pytest.raises(InputError, match="still goes on"):
        remove_run(run)
    assert (run / PARTIAL_POSES).is_file()
    assert (run / "frames.csv").is_file()
    writer.close()
    remove_run(run)
    assert not any(run.iterdir())


def test_what_cannot_be_removed_is_named(run: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(path: Path, missing_ok: bool) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(InputError, match=r"frames\.csv: cannot be removed \(Permission denied\): choose another --out"):
        remove_run(run)
