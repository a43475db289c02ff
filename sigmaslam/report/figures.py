"""Pictures of figures, in files."""

from pathlib import Path
from typing import TYPE_CHECKING

from sigmaslam.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def save_png(figure: "Figure", path: str | Path) -> None:
    """Write the figure as PNG, whole or not at all."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130)
