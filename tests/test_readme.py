"""What the README shows works."""

import re
from pathlib import Path

import numpy as np
import pytest

from sigmaslam import StereoCamera

ROOT = Path(__file__).resolve().parents[1]


def test_the_calibration_file_in_the_readme_can_be_read(tmp_path: Path):
    block = re.search(r"```yaml\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert block
    (tmp_path / "stereo.yaml").write_text(block.group(1))
    camera = StereoCamera.from_yaml(tmp_path / "stereo.yaml")
    np.testing.assert_allclose(camera.baseline, 0.11008, atol=1e-4)
    assert not camera.is_rectified


def test_the_python_in_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("torch")
    text = (ROOT / "README.md").read_text()
    blocks = {name: re.findall(rf"```{name}\n(.*?)```", text, re.DOTALL) for name in ("python", "yaml")}
    assert len(blocks["python"]) == 2
    (tmp_path / "stereo.yaml").write_text(blocks["yaml"][0])
    monkeypatch.chdir(tmp_path)
    image = np.random.default_rng(0).integers(0, 255, (480, 752), dtype=np.uint8)
    names: dict[str, object] = {"left": image, "right": image, "timestamp": 0.0}
    for block in blocks["python"]:
        exec(compile(block, "README.md", "exec"), names)
    assert names["estimate"].covariance.shape == (6, 6)
    assert names["result"].belief.mean.shape == (1000, 2)
