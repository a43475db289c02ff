"""The model card that ships with weights: read, and as a page for people."""

import json
from pathlib import Path
from typing import Any

import jinja2

from sigmaslam.bounded_files import read_text, shorten
from sigmaslam.errors import InputError
from sigmaslam_models.feature_network import DESCRIPTOR_SIZE

_CARD_FIELDS = (
    *("config", "metrics_on_held_out_renders", "parameters", "data", "command", "commit", "seed"),
    *("duration_s", "hardware"),
)
_CARD_BYTES = 1 << 24
REFINED_NAME = " + sigmaslam match"
"""Follows the name of an extractor in the row of what `sigmaslam images match` makes of its features."""
PEER_NAMES = ("sift", "orb", "klt")
"""Rows of `sigmaslam benchmark features` that are always beside ours."""


def read_card(card: Path) -> dict[str, Any]:
    """What a training run says of its weights.

    Raises:
        InputError: the file is missing or says too little.
    """
    if not card.is_file():
        raise InputError(
            f"{card} does not exist: weights ship only with the card that a training writes at its end (--resume)"
        )
    try:
        content: Any = json.loads(read_text(card, _CARD_BYTES, "the card"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{card} is no card of a training run ({shorten(str(error))}): train again") from error
    if not isinstance(content, dict):
        raise InputError(f"{card} is no card of a training run: it is a {type(content).__name__}: train again")
    missing = [name for name in _CARD_FIELDS if name not in content]
    if missing:
        raise InputError(f"{card} is no card of a training run: it says nothing of {', '.join(missing)}")
    return content


def read_scores(path: Path) -> dict[str, dict[str, float]]:
    """Scores of one extractor by set, as `sigmaslam benchmark features` writes them beside its page.

    SIFT, ORB and KLT are left out; those with what `sigmaslam images match` makes of the features get its name.

    Raises:
        InputError: the file cannot be read, or holds the scores of no or several extractors.
    """
    try:
        everyone: dict[str, dict[str, dict[str, float]]] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path} cannot be read ({error}): give the .json of `sigmaslam benchmark features`"
        ) from error
    names = [name for name in everyone if name not in PEER_NAMES and not name.endswith(REFINED_NAME)]
    if len(names) != 1:
        raise InputError(f"{path} holds the scores of {', '.join(names) or 'nobody'}: one extractor is needed")
    refined = everyone.get(names[0] + REFINED_NAME, {})
    return {
        label: {name: round(value, 4) for name, value in scores.items()}
        for of_set in everyone[names[0]]
        for label, scores in ((of_set, everyone[names[0]][of_set]), (of_set + REFINED_NAME, refined.get(of_set, {})))
        if scores
    }


def card_page(card: dict[str, Any]) -> str:
    """The model card for people, in Markdown."""
    real = {
        f"{name} {metric}": value
        for name, values in card.get("metrics_on_real_sets", {}).items()
        for metric, value in values.items()
    }
    return fill_template("features_card.md", card=card, real=real, descriptor_size=DESCRIPTOR_SIZE)


def scoring_page(card: dict[str, Any]) -> str:
    """The card of the scorer and both verifiers for people, in Markdown."""
    return fill_template("matching_card.md", card=card)


def fill_template(name: str, **values: Any) -> str:
    """A page of Markdown from a template of this package."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sigmaslam_models", "templates"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,  # Markdown
    )
    return environment.get_template(name).render(values)
