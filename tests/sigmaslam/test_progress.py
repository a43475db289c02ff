"""Where there is no terminal, progress is said in lines."""

import io

from rich.console import Console

from sigmaslam.progress import open_progress


def run(line_every: float, terminal: bool = False, hidden: bool = False) -> str:
    file = io.StringIO()
    console = Console(file=file, force_terminal=terminal, width=200)
    with open_progress(hidden, console, line_every) as progress:
        task = progress.add_task("training", total=4, note="")
        for step in range(1, 5):
            progress.update(task, completed=step, note=f"loss [{step}]")
    return file.getvalue()


def test_a_line_says_what_is_done_of_how_much():
    lines = run(0.0).splitlines()
    assert lines[0].startswith("training: 1 of 4")
    assert lines[0].endswith("; loss [1]")
    assert [line.split()[1] for line in lines[:4]] == ["1", "2", "3", "4"]


def test_lines_keep_their_distance_in_time():
    assert " of 4" not in run(3600.0)


def test_a_terminal_gets_the_bar_alone_and_a_hidden_one_nothing():
    assert "training: " not in run(0.0, terminal=True)
    assert run(0.0, hidden=True).strip() == ""
