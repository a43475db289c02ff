"""Which eye an image is of, by the names of its file and folders."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

_CAMERA_WORDS = ("cam", "camera", "image", "img", "infra", "ir")
_NUMBERS = (("0", "1"), ("1", "2"), ("2", "3"), ("00", "01"), ("01", "02"), ("02", "03"))
# Letters stand alone between separators, before a number at the end (`imageL01`) or as capitals (`imageL`).
_LETTERS = (
    re.compile(r"(?:^|(?<=[-_. ]))([lr])(?=$|[-_. ])", re.IGNORECASE),
    re.compile(r"([lr])(?=\d+$)", re.IGNORECASE),
    re.compile(r"(?<=[a-z0-9])([LR])(?=$|[-_. ])"),
)


@dataclass(frozen=True, slots=True)
class EyeName:
    """What a path says.

    Attributes:
        eye: 0 for left, 1 for right.
        moments: what both images of a moment may have in common, the surest first: the path without what tells the eye;
            its folders and the numbers in the file's name; the file's name alone.
    """

    eye: int
    moments: tuple[str, str, str]


def eye_tellers() -> Iterator[Callable[[Path], EyeName | None]]:
    """Ways to tell the eyes apart, the surest first; None where a path does not say."""
    words = re.compile("(left|right)", re.IGNORECASE)
    for level in range(4):
        yield _teller(words, ("left", "right"), level)
    for numbers in _NUMBERS:
        for level in range(4):
            # `image_1` in a file's name is the number of an image.
            stems = _CAMERA_WORDS if level else ("cam", "camera", "infra", "ir")
            pattern = re.compile(rf"(?<![a-z])(?:{'|'.join(stems)})[-_ ]?({'|'.join(numbers)})(?!\d)", re.IGNORECASE)
            yield _teller(pattern, numbers, level)
    yield _teller(re.compile(r"_([01])$"), ("0", "1"), 0)
    for pattern in _LETTERS:
        for level in range(4):
            yield _teller(pattern, ("l", "r"), level)


def _teller(pattern: re.Pattern[str], words: tuple[str, str], level: int) -> Callable[[Path], EyeName | None]:
    """Looks at the file's name (level 0) or at the folder that many levels above."""

    def tell(file: Path) -> EyeName | None:
        parts = [*file.parent.parts, file.stem]
        if level >= len(parts):
            return None
        place = len(parts) - 1 - level
        found = pattern.search(parts[place])
        if found is None:
            return None
        parts[place] = parts[place][: found.start(1)] + "*" + parts[place][found.end(1) :]
        digits = "-".join(re.findall(r"\d+", file.stem)) or file.stem
        moments = "/".join(parts), "/".join([*parts[:-1], digits]), parts[-1]
        return EyeName(words.index(found[1].lower()), moments)

    return tell
