"""The page of a check: one HTML file with its findings and the pairs that it looked at."""

from pathlib import Path

import numpy as np

from sigmaslam.checks.check import Check
from sigmaslam.checks.eye_matches import draw_rows
from sigmaslam.checks.finding import verdict, wrong
from sigmaslam.files import atomic_write_text
from sigmaslam.frontend.row_search import ROW_TOLERANCE
from sigmaslam.report.page_parts import data_url, load_template, read_asset
from sigmaslam.run_record.frame_pictures import small_jpeg
from sigmaslam.table import even_rows

# Thumbnails, pixels, and how many.
_WIDTH, _MOST = 640, 4
# So many matches show in a thumbnail.
_SHOWN = 80


def write_page(path: Path, check: Check, source: str) -> None:
    """Writes the page.

    Raises:
        InputError: the folder is missing or cannot be written.
    """
    shown = even_rows(len(check.steps), _MOST).tolist()
    kind, word = verdict(check.findings)
    text = load_template("check.html").render(
        styles=read_asset("report.css"),
        source=source,
        kind=kind,
        word=word,
        faults=wrong(check.findings),
        findings=check.findings,
        pictures=[(f"pair {check.steps[k][0].index}", _picture(check, k)) for k in shown],
        tolerance=ROW_TOLERANCE,
    )
    atomic_write_text(path, text)


def _picture(check: Check, number: int) -> str:
    """A data URI of the rectified pair, left above right, with some of its matches."""
    left, right = check.rectified[number]
    rows = np.flatnonzero(check.matches.pair == number)
    canvas = draw_rows(left, right, check.matches.select(rows[:: max(1, len(rows) // _SHOWN)]), ROW_TOLERANCE)
    return data_url(small_jpeg(canvas, _WIDTH, 80))
