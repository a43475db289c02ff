"""Pages that benchmarks write and people annotate."""

from __future__ import annotations

from pathlib import Path

from sigmaslam.files import atomic_write_text

_MARK = "<!-- notes -->"


def write_page(path: Path, page: str) -> str:
    """Writes a page and returns it; what is below a line `<!-- notes -->` in the one that is there is kept."""
    if path.exists():
        _, mark, notes = path.read_text(encoding="utf-8").partition(_MARK)
        page += mark + notes
    atomic_write_text(path, page)
    return page
