"""manifest.json beside weights and graphs: their SHA-256, as they were exported."""

import hashlib
from pathlib import Path

from sigmaslam.bounded_files import read_json, shorten
from sigmaslam.errors import InputError

MANIFEST_NAME = "manifest.json"
_MANIFEST_BYTES = 1 << 20
_MEND = "reinstall the package, or export the graphs again with `sigmaslam train export`"


def check_weights(path: Path, content: bytes) -> None:
    """Compares a file of weights with the manifest beside it; without a manifest, or if it is not in it, it may pass.

    Raises:
        InputError: the file is not the one that was exported, or the manifest cannot be read.
    """
    manifest = path.parent / MANIFEST_NAME
    if not manifest.is_file():
        return
    expected = read_manifest(manifest).get(path.name)
    actual = hashlib.sha256(content).hexdigest()
    if expected is not None and expected != actual:
        raise InputError(
            f"{path}: is not the file that was exported (SHA-256 {actual[:12]}..., {manifest.name} beside it says "
            f"{shorten(expected, 15)}): {_MEND}"
        )


def read_manifest(path: Path) -> dict[str, str]:
    """SHA-256 in hexadecimal digits by file name.

    Raises:
        InputError: the file cannot be read, or is no such table.
    """
    content = read_json(path, "the hashes of the weights", _MEND, limit=_MANIFEST_BYTES)
    if not isinstance(content, dict) or not all(isinstance(each, str) for each in content.values()):
        raise InputError(f"{path}: is no table of file names and SHA-256: {_MEND}")
    return content
