"""What the README shows works."""

import re
from pathlib import Path

import numpy as np

from sigmaslam import StereoCamera

ROOT = Path(__file__).resolve().parents[1]


def test_the_calibration_file_in_the_readme_can_be_read(tmp_path: Path):
    block = re.search(r"```yaml\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert block
    (tmp_path / "stereo.yaml").write_text(block.group(1))
    camera = StereoCamera.from_yaml(tmp_path / "stereo.yaml")
    np.testing.assert_allclose(camera.baseline, 0.11008, atol=1e-4)
    assert not camera.is_rectified


def test_links_in_the_pages_lead_to_files():
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            assert target.startswith("http") or (page.parent / target).exists(), f"{page.name} links to {target}"
