"""How well an extractor matches real images: sets of pairs with truth, scores, and everyone under the same rules."""

from sigmaslam_benchmarks.matching.comparison import compare
from sigmaslam_benchmarks.matching.extractors import Extractor, LearnedExtractor, load_extractor
from sigmaslam_benchmarks.matching.image_pairs import ImagePair
from sigmaslam_benchmarks.matching.peer_extractors import PeerExtractor
from sigmaslam_benchmarks.matching.score_sets import format_scores, score_pairs
from sigmaslam_benchmarks.matching.sets import FINAL, SELECTION, check_sets, load_set

__all__ = [
    "FINAL",
    "SELECTION",
    "Extractor",
    "ImagePair",
    "LearnedExtractor",
    "PeerExtractor",
    "check_sets",
    "compare",
    "format_scores",
    "load_extractor",
    "load_set",
    "score_pairs",
]
