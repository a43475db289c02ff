"""The progress of everything that takes long, on the standard error: a bar, or lines where there is no terminal."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID

LINE_EVERY = 30.0
"""Seconds between lines."""


@contextmanager
def counted(title: str, total: int | None) -> Iterator[Callable[[], None]]:
    """The progress of one task, of so many steps; the function is called after each."""
    with open_progress() as progress:
        task = progress.add_task(title, total=total, note="")
        yield lambda: progress.update(task, advance=1)


def open_progress(hidden: bool = False, console: "Console | None" = None, line_every: float = LINE_EVERY) -> "Progress":
    """Tasks with a field `note`, behind the bar and the time that is left.

    Args:
        hidden: nothing is shown.
        console: where to; by default the standard error.
        line_every: seconds between lines, where the console is a file or a pipe.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    class LineProgress(Progress):
        """A bar that says a line now and then where it cannot be drawn."""

        _said = time.monotonic()

        def update(self, task_id: "TaskID", *args: float, **fields: object) -> None:
            super().update(task_id, *args, **fields)  # type: ignore[arg-type]
            now = time.monotonic()
            if hidden or self.console.is_terminal or self.console.is_jupyter or now - self._said < line_every:
                return
            self._said = now
            task = self._tasks[task_id]
            seconds = task.time_remaining
            left = "" if seconds is None else f", {int(seconds) // 60}:{int(seconds) % 60:02d} min left"
            note = task.fields.get("note")
            self.console.print(
                f"{task.description}: {task.completed:g}"
                + ("" if task.total is None else f" of {task.total:g}")
                + left
                + (f"; {note}" if note else ""),
                highlight=False,
                markup=False,
                soft_wrap=True,
            )

    return LineProgress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=16),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("left,"),
        TextColumn("{task.fields[note]}"),
        console=console or Console(stderr=True),
        disable=hidden,
    )
