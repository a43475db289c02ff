"""`python -m sigmaslam.evaluation.matching`: SIFT, ORB and weights files side by side."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path

from sigmaslam.errors import SigmaSlamError
from sigmaslam.evaluation.matching.extractors import CLASSICAL, load_extractor
from sigmaslam.evaluation.matching.run import Scores, format_scores, score_pairs
from sigmaslam.evaluation.matching.sets import FINAL, SELECTION, load_set


def main() -> None:
    """Parses, scores, prints; progress goes to the standard error."""
    parser = argparse.ArgumentParser(
        prog="python -m sigmaslam.evaluation.matching",
        description="How well SIFT, ORB and our networks match real images: at most 1,024 keypoints, long side 640, "
        "mutual nearest neighbours. The folder of the data sets is taken from SIGMASLAM_DATA.",
    )
    parser.add_argument("--weights", nargs="*", type=Path, default=[], metavar="FILE", help=".safetensors or .onnx")
    parser.add_argument(
        "--sets", default=",".join(SELECTION), help=f"comma-separated, of {', '.join(SELECTION + FINAL)} (%(default)s)"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    arguments = parser.parse_args()
    try:
        results = _score_all(arguments.weights, arguments.sets.split(","))
    except SigmaSlamError as error:
        sys.exit(f"error: {error}")
    print(json.dumps(results, indent=2) if arguments.json else format_scores(results))


def _score_all(weights: list[Path], sets: list[str]) -> dict[str, Scores]:
    data = Path(os.environ.get("SIGMASLAM_DATA", ""))
    names = [*CLASSICAL, *map(str, weights)]
    extractors = {name: load_extractor(name) for name in names}
    results: dict[str, Scores] = {name: {} for name in extractors}
    for name in sets:
        pairs = load_set(name, data)
        for label, extractor in extractors.items():
            start = time.perf_counter()
            results[label][name] = score_pairs(extractor, pairs)
            seconds = time.perf_counter() - start
            print(f"{name}: {label}, {len(pairs)} pairs in {seconds:.1f} s", file=sys.stderr)
    return results


if __name__ == "__main__":
    main()
