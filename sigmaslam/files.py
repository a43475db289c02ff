"""Files that appear whole or not at all."""

import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sigmaslam.errors import InputError


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A new, empty file in the same folder that replaces `path` when the block ends without an error.

    After an error `path` is as it was before and the new file is gone. The name of the new file ends like
    `path`, so writers that look at the suffix (numpy, matplotlib) behave.

    Args:
        path: the file to write; its folder must exist.
    Yields:
        The path to write to inside the block.
    Raises:
        InputError: the folder does not exist or cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(6)}{path.suffix}")
    try:
        temporary.touch(exist_ok=False)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(
            f"{path}: cannot write into the folder {path.parent} ({reason}): create it, or choose another"
        ) from error
    try:
        yield temporary
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def atomic_write_text(path: str | Path, text: str) -> None:
    """Write `text` as UTF-8; see `atomic_path`."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def atomic_write_bytes(path: str | Path, content: bytes) -> None:
    """Write `content`; see `atomic_path`."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
