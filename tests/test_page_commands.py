"""Commands and options on the pages, and in tables beside them, are the command line's; scripts and targets exist.

The notebook, the changes and pages of benchmarks are history: their commands are those of their day.
`tests/release/test_pages.py` runs commands as they stand.
"""

import itertools
import re
import shlex
from pathlib import Path

import pytest
import typer

from sigmaslam.cli.commands import DEFAULTS, app

ROOT = Path(__file__).resolve().parents[1]
PAGES = [page for folder in (ROOT, ROOT / "docs", ROOT / "examples") for page in sorted(folder.glob("*.md"))]
PAGES.remove(ROOT / "CHANGELOG.md")
COMMANDS = typer.main.get_command(app)
# They act while they are parsed: one of them writes into the home folder.
EAGER = {"--help", "--install-completion", "--show-completion", "--version"}
# Typer may bring its own click; this is a public name of it.
UsageError = typer.BadParameter.__base__
# Options of other programs that pages name.
FOREIGN = {"--ages", "--index-url", "--many-linux", "--nproc-per-node", "--part", "--truth-sigmas"}
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*")
PROGRAM = "sigmaslam "


def parts(page: Path) -> tuple[list[str], list[str]]:
    """Lines of the blocks without a language, comments left out, and the code inside sentences."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    lines = [
        line.partition("  #")[0].strip() for language, block in blocks if not language for line in block.split("\n")
    ]
    prose = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    return lines, [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", prose)]


def commands(lines: list[str]) -> list[str]:
    """Each command of the program in these lines, apart, without `> file`; `a|b` without spaces stands for either."""
    found = []
    for line in lines:
        for command in re.split(r" && | \| ", line):
            if command.startswith(PROGRAM):
                words = shlex.split(re.split(r" \(| > ", command)[0])
                choices = [re.split(r"\|", word) for word in words]
                found += [shlex.join(words) for words in itertools.product(*choices)]
    return found


def parse(command: str) -> None:
    """Raises UsageError where the command line would refuse the words of a command; runs nothing.

    Options that act while they are parsed are left out.
    """
    group, words = COMMANDS, [word for word in shlex.split(command)[1:] if word not in EAGER]
    while words and not words[0].startswith("-") and hasattr(group, "commands"):
        if words[0] not in group.commands and group.name in DEFAULTS:
            words = [DEFAULTS[group.name], *words]
        if words[0] not in group.commands:
            raise UsageError(f"there is no command {words[0]}")
        group, words = group.commands[words[0]], words[1:]
    if words or not hasattr(group, "commands"):
        group.make_context(group.name, list(words))


def options() -> set[str]:
    """All options of all commands, and of the scripts in examples/ and training/."""
    pending, found = [COMMANDS], EAGER.copy()
    for script in (*(ROOT / "examples").glob("*.py"), *(ROOT / "training").glob("*.py")):
        found |= set(OPTION.findall(script.read_text()))
    while pending:
        command = pending.pop()
        pending += getattr(command, "commands", {}).values()
        for parameter in command.params:
            found |= {*parameter.opts, *parameter.secondary_opts}
    return found


BLOCKS = [(page, command) for page in PAGES for command in commands(parts(page)[0])]
TABLES = sorted((ROOT / "docs").glob("*.csv"))
MENTIONS = [(page, command) for page in (*PAGES, *TABLES) for command in commands(parts(page)[1])]


@pytest.mark.parametrize(("page", "command"), BLOCKS, ids=lambda each: getattr(each, "name", each))
def test_a_command_in_a_block_is_understood(page: Path, command: str):
    parse(command)


@pytest.mark.parametrize(("page", "command"), MENTIONS, ids=lambda each: getattr(each, "name", each))
def test_a_command_in_a_sentence_has_only_names_that_exist(page: Path, command: str):
    """It may lack what it needs, and have words in capitals in place of values."""
    try:
        parse(command)
    except UsageError as error:
        message = error.format_message()
        filled_in = [option for option, value in itertools.pairwise(command.split()) if value.isupper()]
        if not (message.startswith("Missing ") or any(f"'{option}'" in message for option in filled_in)):
            pytest.fail(message)


@pytest.mark.parametrize("page", [*PAGES, *TABLES], ids=lambda page: page.name)
def test_every_option_on_a_page_exists(page: Path):
    lines, spans = parts(page)
    named = {option for text in lines + spans for option in OPTION.findall(text)}
    assert named - FOREIGN <= options()


def test_there_are_commands_on_the_pages():
    assert len(BLOCKS) > 50
    assert len(MENTIONS) > 50
    assert {command.split()[1] for _, command in BLOCKS} >= {
        "track",
        "evaluate",
        "images",
        "train",
        "localize",
    }


@pytest.mark.parametrize(
    "command",
    [
        "sigmaslam trak FOLDER --out run",
        "sigmaslam track FOLDER --out run --frontends sift",
        "sigmaslam track FOLDER --out run --frontend surf",
        "sigmaslam track FOLDER OTHER --out run",
        "sigmaslam calibration invert a.yaml",
        "sigmaslam train render street --out drive --frames many",
    ],
)
def test_a_command_that_is_wrong_is_found(command: str):
    with pytest.raises(UsageError):
        parse(command)


def test_scripts_and_targets_on_the_pages_exist():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in PAGES:
        lines, spans = parts(page)
        for text in lines + spans:
            for target in re.findall(r"^make ([a-z-]+)", text):
                assert target in targets, f"{page.name}: make {target}"
            for script in re.findall(r"^python ([\w/]+\.py)", text):
                assert (ROOT / script).is_file(), f"{page.name}: {script}"
            for module in re.findall(r"^python -m (tests\.\w+)", text):
                path = ROOT / module.replace(".", "/")
                assert path.is_dir() or path.with_suffix(".py").is_file(), f"{page.name}: {module}"
