"""What the README shows works, and the Python on the other pages."""

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import sigmaslam
from sigmaslam import StereoCamera

ROOT = Path(__file__).resolve().parents[1]
# docs/filters.md has a test of its own.
PAGES = [
    page for page in sorted((ROOT / "docs").glob("*.md")) if "```python" in page.read_text() and page.stem != "filters"
]
# The demo, enlarged until the box on the pages lies in its images.
ZOOM = 3


def _calibration_file() -> str:
    block = re.search(r"```yaml\n(.*?)```", (ROOT / "docs" / "usage.md").read_text(), re.DOTALL)
    assert block
    return block.group(1)


def test_the_calibration_file_on_the_page_can_be_read(tmp_path: Path):
    (tmp_path / "stereo.yaml").write_text(_calibration_file())
    camera = StereoCamera.from_yaml(tmp_path / "stereo.yaml")
    np.testing.assert_allclose(camera.baseline, 0.11008, atol=1e-4)
    assert not camera.is_rectified


@pytest.mark.long
def test_the_python_in_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("torch")
    text = (ROOT / "README.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(blocks) == 2
    (tmp_path / "stereo.yaml").write_text(_calibration_file())
    monkeypatch.chdir(tmp_path)
    image = np.random.default_rng(0).integers(0, 255, (480, 752), dtype=np.uint8)
    names: dict[str, object] = {"left": image, "right": image, "timestamp": 0.0}
    names["pairs"] = [(image, image, 0.0), (image, image, 0.1)]
    for block in blocks:
        exec(compile(block, "README.md", "exec"), names)
    assert names["estimate"].covariance.shape == (6, 6)
    assert names["result"].belief.mean.shape == (1000, 2)


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_python_on_a_page_runs(page: Path, demo_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """With the names and files that the text around it speaks of."""
    pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    sequence = sigmaslam.open_sequence(demo_sequence)
    frame = next(sequence.frames())
    left, right = (cv2.resize(each, None, fx=ZOOM, fy=ZOOM) for each in (frame.left, frame.right))
    if page.stem == "usage":  # its camera is that of the calibration file
        left, right = (cv2.resize(each, (752, 480)) for each in (left, right))
    cv2.imwrite("one.jpg", left)
    cv2.imwrite("two.png", right)
    Path("stereo.yaml").write_text(_calibration_file())
    shutil.copytree(demo_sequence, "FOLDER")
    for folder in ("drive", "tool1"):
        Path(folder).mkdir()
    shutil.copy(demo_sequence / "scene.json", "drive")
    np.savetxt("tool1/poses_object.txt", np.tile(np.eye(4)[:3].ravel(), (75, 1)))
    np.savetxt("tool1/times.txt", np.arange(75) / 25)
    names = {
        "sigmaslam": sigmaslam,
        "camera": sequence.camera.scaled(ZOOM),
        "left": left,
        "right": right,
        "image0": left,
        "image1": right,
        "timestamp": 0.0,
    }
    for block in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL):
        exec(compile(block, page.name, "exec"), names)
    assert "matches" not in names or len(names["matches"].probability) > 50
