"""Pages that benchmarks write and people annotate, and what their tables are made of."""

import os
import platform
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jinja2
import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_write_text, csv_text
from sigmaslam_benchmarks.source_description import describe_source

_MARK = "<!-- notes -->"
_ASIDE = re.compile(r"<!-- rows ([\w-]+) -->\n(.*?)<!-- end -->\n", re.DOTALL)

T = TypeVar("T")


def write_page(path: Path, page: str) -> str:
    """Writes a page and returns it; what is below a line `<!-- notes -->` in the one that is there is kept.

    Tables between `<!-- rows NAME -->` and `<!-- end -->` go to PAGE.NAME.csv; the page links to that.
    """
    page = _ASIDE.sub(lambda found: _put_aside(path, *found.groups()), page)
    if path.exists():
        _, mark, notes = path.read_text(encoding="utf-8").partition(_MARK)
        page += mark + notes
    atomic_write_text(path, page)
    return page


def _put_aside(path: Path, name: str, part: str) -> str:
    """Writes the tables of a part of a page, one below the other, and returns what the page says of them."""
    target = path.with_suffix(f".{name}.csv")
    lines = [line for line in part.splitlines() if line.startswith("|") and not set(line) <= set("|-: ")]
    cells = ([cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines)
    atomic_write_text(target, csv_text(cells))
    return f"[{target.name}]({target.name}), {len(lines) - 1} rows.\n"


def fill_page(template: str, command: str, **values: Any) -> str:
    """The page of a template, which also knows what it was made by, of which sources, and where.

    Args:
        template: name in `sigmaslam_benchmarks/templates`, without .md.
        values: all others that the template names; `machine`, if it is described otherwise than by `machine`.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sigmaslam_benchmarks", "templates"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        autoescape=False,  # Markdown
    )
    environment.filters["row"] = lambda cells: f"| {' | '.join(cells)} |"
    values = {"machine": machine(), **values, "command": command, "source": describe_source()}
    # Blocks end with an empty line, the page does not.
    return environment.get_template(f"{template}.md").render(values).rstrip("\n") + "\n"


def machine() -> str:
    """Kind of processor, and its cores."""
    return f"{platform.machine()}, {os.cpu_count()} cores"


def number(value: float, form: str) -> str:
    """A cell; a dash where there is no number."""
    return format(value, form) if np.isfinite(value) else "-"


def number_with_error(value: float, error: float, form: str) -> str:
    """A cell; the error is left out where it is NaN."""
    return number(value, form) + ("" if np.isnan(error) else f" ± {format(error, form.replace('+', ''))}")


def write_results_page(path: Path, results: Iterable[T], form: Callable[[list[T], bool], str]) -> str:
    """Writes the page of results that come one by one and returns it; also, of those there are, when it is stopped.

    Args:
        path: Markdown page, as of `write_page`.
        results: as they are found.
        form: the page of results, and whether they are all.
    """
    found: list[T] = []
    try:
        for result in results:
            found.append(result)
    except BaseException:
        if found:
            write_page(path, form(found, False))
        raise
    return write_page(path, form(found, True))


def check_names(kind: str, names: Sequence[str], choices: Sequence[str]) -> None:
    """InputError where one of the names is not among the choices."""
    for name in names:
        if name not in choices:
            raise InputError(f"{kind} {name!r} is unknown; choose of {', '.join(choices)}")
