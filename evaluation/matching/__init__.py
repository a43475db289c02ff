"""How well an extractor matches real images: sets of pairs with truth, scores, and everyone under the same rules."""

from sigmaslam.evaluation.matching.comparison import compare, read_scores
from sigmaslam.evaluation.matching.extractors import Extractor, LearnedExtractor, load_extractor
from sigmaslam.evaluation.matching.image_pairs import ImagePair
from sigmaslam.evaluation.matching.peer_extractors import PeerExtractor
from sigmaslam.evaluation.matching.score_sets import format_scores, score_pairs
from sigmaslam.evaluation.matching.sets import FINAL, SELECTION, check_sets, load_set

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
    "read_scores",
    "score_pairs",
]
