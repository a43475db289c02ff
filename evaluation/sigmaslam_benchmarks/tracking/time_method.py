"""One method over decoded pairs, in a process of its own, so that its start-up, memory and CPU time are its own.

`python -m sigmaslam_benchmarks.tracking.time_method JOB` prints one JSON object; JOB is a `TimingJob` as JSON. What
only some methods need is imported by them alone: start-up counts it.
"""

import json
import os
import re
import resource
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

import sigmaslam
from sigmaslam.errors import SigmaSlamError
from sigmaslam_benchmarks.tracking.decoded_pairs import DecodedPairs, open_pairs
from sigmaslam_benchmarks.tracking.stereo_peers import PEERS, RECTIFIED, MissingPeerError, open_peer

WARM_UP = 2
"""Frames that are not counted: they build what later ones use."""
OURS = {"ours": "learned", "sift": "sift", "orb": "orb", "klt": "klt"}
"""The tracker's front-end by method."""
METHODS = (*OURS, *PEERS)
"""In the order of the page."""


@dataclass(frozen=True, slots=True)
class TimingJob:
    """What is timed.

    Attributes:
        pairs: folder of `write_pairs`.
        method: of `METHODS`.
        threads: of every library; the process is held on so many cores.
    """

    pairs: str
    method: str
    threads: int = 1


@dataclass(frozen=True, slots=True)
class MethodTiming:
    """What a method took for N frames after the warm-up, and the poses of all that it tracked.

    Attributes:
        cpu_ms: (N,) CPU time of all threads of the process from one frame to the next, without the reading of pairs.
        wall_ms: (N,).
        frames: of the sequence.
        timestamps, poses: (M,) and (M, 4, 4) T_world_camera, of the frames with a pose.
        first_pose_s: from the start of the process to the pose of the second frame; NaN without one.
        peak_mib: largest resident memory.
        version: of a peer's package.
        keyframes: (N,) whether the frame became a keyframe; empty where a method does not say.
        joules: that the processor took for all frames; NaN where the machine does not tell.
    """

    cpu_ms: list[float]
    wall_ms: list[float]
    frames: int
    timestamps: list[float]
    poses: list[list[list[float]]]
    first_pose_s: float
    peak_mib: float
    version: str = ""
    keyframes: list[bool] = field(default_factory=list)
    joules: float = float("nan")


class FailedMethodError(SigmaSlamError):
    """A method's process ended without a result."""


class _Method(Protocol):
    """Steps through the pairs; a step gives the pose, or None where there is none."""

    rectified: bool
    version: str
    keyframes: list[bool]

    def step(self, left: np.ndarray, right: np.ndarray, timestamp: float) -> np.ndarray | None: ...

    def close(self) -> None: ...


def time_method(job: TimingJob) -> MethodTiming:
    """Times a method in a process of its own.

    Raises:
        MissingPeerError: it is not installed.
        FailedMethodError: the process ended otherwise than with a result.
    """
    package = Path(sigmaslam.__file__).parents[1]
    paths = [str(package), *filter(None, [os.environ.get("PYTHONPATH")])]
    # Libraries read their number of threads when they are loaded.
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), str(job.threads))
    done = subprocess.run(
        [sys.executable, "-m", __spec__.name, json.dumps({"started": time.time(), "job": asdict(job)})],
        env={**os.environ, **threads, "PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        last = [line for line in re.sub(r"\x1b\[[0-9;]*m", "", done.stderr).splitlines() if line.strip()][-1:]
        raise FailedMethodError(": ".join([f"its process ended with code {done.returncode}", *last]))
    content = json.loads(done.stdout)
    if "missing" in content:
        raise MissingPeerError(content["missing"])
    return MethodTiming(**content)


def run_job(job: TimingJob, started: float) -> MethodTiming:
    """Times a method in this process.

    Args:
        job: what is timed.
        started: time.time() when the process was started.
    """
    _hold_on_cores(job.threads)
    pairs = open_pairs(Path(job.pairs))
    method = _open(job, pairs)
    poses, walls, own, others = [], [], [], []
    first_pose, energy = float("nan"), _joules()
    for index, timestamp in enumerate(pairs.timestamps):
        left, right = pairs.read(index, method.rectified)
        others.append(_other_threads())
        cpu, wall = time.thread_time(), time.perf_counter()
        pose = method.step(left, right, timestamp)
        own.append(time.thread_time() - cpu)
        walls.append(time.perf_counter() - wall)
        if index and pose is not None and np.isnan(first_pose):
            first_pose = time.time() - started
        poses.append(pose)
    # Threads in the background go on while the next pair is read.
    cpus = np.array(own) + np.diff([*others, _other_threads()])
    peak, energy = _peak_mib(), _joules() - energy
    method.close()
    tracked = [(time, pose) for time, pose in zip(pairs.timestamps, poses, strict=True) if pose is not None]
    return MethodTiming(
        cpu_ms=_milliseconds(cpus[WARM_UP:]),
        wall_ms=_milliseconds(walls[WARM_UP:]),
        frames=len(poses),
        timestamps=[time for time, _ in tracked],
        poses=[pose.tolist() for _, pose in tracked],
        first_pose_s=first_pose,
        peak_mib=peak,
        version=method.version,
        keyframes=method.keyframes[WARM_UP:],
        joules=energy if energy >= 0.0 else float("nan"),  # the counter begins anew
    )


def _open(job: TimingJob, pairs: DecodedPairs) -> _Method:
    if job.method not in RECTIFIED:
        import cv2

        cv2.setNumThreads(job.threads)
    return _Peer(job.method, pairs) if job.method in PEERS else _Ours(job, pairs)


class _Ours:
    rectified = False

    def __init__(self, job: TimingJob, pairs: DecodedPairs) -> None:
        from sigmaslam.slam.tracker import StereoTracker

        self.version = ""
        self.keyframes: list[bool] = []
        self._tracker = StereoTracker(pairs.camera, OURS[job.method], threads=job.threads)

    def step(self, left: np.ndarray, right: np.ndarray, timestamp: float) -> np.ndarray | None:
        estimate = self._tracker.step(left, right, timestamp)
        self.keyframes.append(estimate.tracks is not None)
        return estimate.T_world_camera if estimate.has_pose and estimate.status not in ("lost", "skipped") else None

    def close(self) -> None:
        """It needs no end."""


class _Peer:
    def __init__(self, name: str, pairs: DecodedPairs) -> None:
        self.rectified = name in RECTIFIED
        camera = pairs.rectified if self.rectified else pairs.camera
        # It is the only one of this process, whose time and memory are measured.
        self._peer = open_peer(name, camera, pairs.timestamps, own_process=False)
        self.version = self._peer.version
        self.keyframes: list[bool] = []

    def step(self, left: np.ndarray, right: np.ndarray, timestamp: float) -> np.ndarray | None:
        step = self._peer.step(left, right, timestamp)
        return None if step.status == "lost" else step.T_world_camera

    def close(self) -> None:
        self._peer.close()


def _hold_on_cores(count: int) -> None:
    """Keeps this process on the first cores that it may use, where the system can."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:count])


def _other_threads() -> float:
    """CPU seconds so far of all threads but this one."""
    return time.process_time() - time.thread_time()


def _joules() -> float:
    """That the processor's first package has taken so far, by Intel's counter; NaN where there is none to read."""
    try:
        return 1e-6 * int(Path("/sys/class/powercap/intel-rapl:0/energy_uj").read_text(encoding="ascii"))
    except OSError:
        return float("nan")


def _milliseconds(seconds: Iterable[float]) -> list[float]:
    return [round(1e3 * float(each), 3) for each in seconds]


def _peak_mib() -> float:
    """Largest resident memory of this process."""
    status = Path("/proc/self/status")
    if status.exists():
        # getrusage has the peak of the parent, too, from before this process was its own.
        (line,) = (line for line in status.read_text(encoding="ascii").splitlines() if line.startswith("VmHWM:"))
        return int(line.split()[1]) / 1024.0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024.0**2 if sys.platform == "darwin" else 1024.0)


def main() -> None:
    """Does the job of the command line."""
    # What libraries print goes to the standard error: the standard output is the result's alone.
    result = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    content = json.loads(sys.argv[1])
    try:
        answer = asdict(run_job(TimingJob(**content["job"]), content["started"]))
    except MissingPeerError as error:
        answer = {"missing": str(error)}
    with result:
        json.dump(answer, result)


if __name__ == "__main__":
    main()
