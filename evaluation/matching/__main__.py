"""`python -m sigmaslam.evaluation.matching`: SIFT, ORB, weights files and other people's graphs side by side."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

from sigmaslam.errors import InputError, SigmaSlamError
from sigmaslam.evaluation.matching.comparison import compare
from sigmaslam.evaluation.matching.extractors import CLASSICAL
from sigmaslam.evaluation.matching.score_sets import format_scores
from sigmaslam.evaluation.matching.sets import ALL, SELECTION


def main() -> None:
    """Parses, scores, prints; progress goes to the standard error."""
    parser = argparse.ArgumentParser(
        prog="python -m sigmaslam.evaluation.matching",
        description="How well SIFT, ORB, our networks and other people's match real images: at most 1,024 keypoints "
        "(kitti_tracks: 2,048), long side 640, mutual nearest neighbours. The folder of the data sets is taken from "
        "SIGMASLAM_DATA.",
    )
    parser.add_argument(
        "--weights", nargs="*", type=Path, default=[], metavar="FILE", help=".safetensors or .onnx, ours or a peer's"
    )
    parser.add_argument(
        "--sets", default=",".join(SELECTION), help=f"comma-separated, of {', '.join(ALL)} (%(default)s)"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    arguments = parser.parse_args()
    try:
        data = os.environ.get("SIGMASLAM_DATA")
        if not data:
            raise InputError("the folder of the real data sets is not known: set SIGMASLAM_DATA")
        names = [*CLASSICAL, *map(str, arguments.weights)]
        results = compare(names, arguments.sets.split(","), Path(data), lambda text: print(text, file=sys.stderr))
    except SigmaSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    print(json.dumps(results, indent=2) if arguments.json else format_scores(results))


if __name__ == "__main__":
    main()
