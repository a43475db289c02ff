"""Hashes of code: what a figure and a render depend on."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

import sigmaslam
import sigmaslam_synthetic
from sigmaslam_benchmarks import code_hash
from sigmaslam_benchmarks.code_hash import code_files, hash_code, hash_renderer


@pytest.fixture
def copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Folder with copies of the packages, which the hashes see in place of the ones that are installed."""
    for package in (sigmaslam, sigmaslam_synthetic):
        folder = Path(package.__path__[0])
        shutil.copytree(folder, tmp_path / folder.name, ignore=shutil.ignore_patterns("__pycache__"))
    found = code_hash.find_spec

    class Spec:
        def __init__(self, name: str) -> None:
            self.origin = str(tmp_path / name / "__init__.py")

    monkeypatch.setattr(code_hash, "find_spec", lambda name: Spec(name) if (tmp_path / name).is_dir() else found(name))
    clear()
    yield tmp_path
    clear()


def clear() -> None:
    code_hash._files_of.cache_clear()
    hash_renderer.cache_clear()


@pytest.mark.long
@pytest.mark.parametrize("name", ["kernels.cpp", "kernels.inc"])
def test_a_byte_of_a_kernel_changes_the_hash_of_what_tracks(copy: Path, name: str):
    benchmark = copy / "benchmark.py"
    benchmark.write_text("def run():\n    from sigmaslam.runs.track import track_sequence\n")
    before = hash_code(benchmark)
    assert hash_code(benchmark) == before
    kernel = copy / "sigmaslam" / "frontend" / name
    kernel.write_bytes(kernel.read_bytes() + b" ")
    assert hash_code(benchmark) != before


@pytest.mark.long
def test_a_byte_of_a_renderer_module_changes_both_hashes(copy: Path):
    benchmark = copy / "benchmark.py"
    benchmark.write_text("from sigmaslam_synthetic.render_sequence import write_sequence\n")
    before = hash_code(benchmark), hash_renderer()
    module = copy / "sigmaslam_synthetic" / "rendering" / "renderer.py"
    module.write_bytes(module.read_bytes() + b"\n")
    clear()
    assert hash_code(benchmark) != before[0]
    assert hash_renderer() != before[1]


def test_what_is_not_imported_and_what_forms_pages_is_left_out(tmp_path: Path):
    module = tmp_path / "benchmark.py"
    module.write_text("from sigmaslam_benchmarks.tracking import sequences_page\nimport numpy\n")
    names = {path.name for path in code_files(module)}
    assert names >= {"benchmark.py", "__init__.py"}
    assert not names & {"sequences_page.py", "renderer.py"}
