"""Colours and axes of every figure, and what to say where matplotlib is not installed."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's palette, which people with colour-blindness can tell apart.
BLUE, VERMILLION, GREEN, ORANGE = "#0072B2", "#D55E00", "#009E73", "#E69F00"
SKY, PURPLE, GREY, BLACK = "#56B4E9", "#CC79A7", "#8C8C8C", "#1A1A1A"
SERIES = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)
"""Colours of series in the order to use them."""

NO_MATPLOTLIB = "matplotlib is not installed: pip install 'sigmaslam[report]' for the pictures"


def has_matplotlib() -> bool:
    """Whether figures can be drawn here."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        return False
    return True


def style_axes(axes: "Axes") -> None:
    """Draw a light grid, and no frame at the top and right."""
    axes.grid(True, color="#D9D9D9", lw=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def bgr(colour: str) -> tuple[int, int, int]:
    """A colour `#RRGGBB` in OpenCV's order."""
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return blue, green, red
