"""Hashes of poses, covariances and maps of six runs: two commits that must not differ are compared to the bit.

python -m tests.equal_runs OUT.json                      # runs, and writes the hashes
python -m tests.equal_runs OUT.json --against OTHER.json # exits with 1 where a hash differs

Runs on real data are left out where SIGMASLAM_DATA is empty.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

RENDERS = {
    "room": ("room", "--frames", "30", "--seed", "3", "--truth", "sparse"),
    "tool": ("tool", "--frames", "30", "--seed", "1", "--truth", "sparse"),
}
# Arguments of `sigmaslam track`; {data} and {renders} are folders.
RUNS = {
    "kitti_drive": ("{data}/kitti_raw_0926_0039_a", "--frames", "60"),
    "kitti_01": ("{data}/kitti_odometry_01_f000_050",),
    "euroc_keyframes": ("{data}/euroc_v1_01_keyframes_a",),
    "room": ("{renders}/room",),
    "tool": ("{renders}/tool", "--track-object", "0,205,390,155"),
}
FILES = ("trajectory.tum", "trajectory.kitti", "covariance.npy", "map.npz")


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path, help="JSON file for the hashes")
    parser.add_argument("--against", type=Path, help="hashes of another commit")
    parser.add_argument("--renders", type=Path, help="folder that keeps the rendered inputs between two commits")
    arguments = parser.parse_args()
    other = json.loads(arguments.against.read_text(encoding="utf-8")) if arguments.against else None
    with tempfile.TemporaryDirectory() as name:
        hashes = run_hashes(Path(name), arguments.renders or Path(name) / "renders")
    arguments.out.write_text(json.dumps(hashes, indent=1) + "\n", encoding="utf-8")
    if other is not None:
        differing = [key for key in sorted({*hashes, *other}) if hashes.get(key) != other.get(key)]
        print(f"{len(hashes)} results, {len(differing)} of them differ", *differing, sep="\n  ")
        sys.exit(bool(differing))


def run_hashes(work: Path, renders: Path) -> dict[str, str]:
    """SHA-256 of each result, by `run/file`.

    Args:
        work: an empty folder for the runs.
        renders: folder of the rendered inputs; what it lacks is rendered.
    """
    for render, options in RENDERS.items():
        if not (renders / render).is_dir():
            _sigmaslam("render", *options, "--out", str(renders / render))
    _sigmaslam("demo", "--out", str(work / "demo"))
    done = ["demo"]
    data = os.environ.get("SIGMASLAM_DATA", "")
    for run, options in RUNS.items():
        if data or "{data}" not in options[0]:
            filled = [option.format(data=data, renders=renders) for option in options]
            # A run that hardly tracks exits with 3 and is compared all the same.
            _sigmaslam("track", *filled, "--threads", "1", "--out", str(work / run), accepted=(0, 3))
            done.append(run)
    return {f"{run}/{file}": hash_file(work / run / file) for run in done for file in FILES}


def hash_file(path: Path) -> str:
    """SHA-256 of a file; of an archive, of its arrays, as its bytes hold times."""
    if path.suffix != ".npz":
        return hashlib.sha256(path.read_bytes()).hexdigest()
    digest = hashlib.sha256()
    with np.load(path) as arrays:
        for name in sorted(arrays):
            digest.update(f"{name} {arrays[name].dtype} {arrays[name].shape}".encode())
            digest.update(arrays[name].tobytes())
    return digest.hexdigest()


def _sigmaslam(*arguments: str, accepted: tuple[int, ...] = (0,)) -> None:
    command = [str(Path(sys.executable).with_name("sigmaslam")), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode not in accepted:
        sys.exit(f"{' '.join(command)} exited with {done.returncode}:\n{done.stderr}{done.stdout}")


if __name__ == "__main__":
    main()
