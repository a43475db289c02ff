"""The materials of one scene, made of few textures in many sizes and greys."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sigmaslam_synthetic.scene import Material, Texture
from sigmaslam_synthetic.worlds.episode import Wish

# Of real streets more is in light and shade than in texture: measured by gradients against KITTI.
_CONTRAST = 0.65


class Palette:
    """Materials by number.

    Args:
        rng: source of the choice of textures.
        wish: whose bank they come from.
        world: name in palettes.yaml, which says what textures and materials it has.
    """

    def __init__(self, rng: np.random.Generator, wish: Wish, world: str) -> None:
        made_of = _palettes()[world]
        self.materials: list[Material] = []
        self._textures = {
            kind: [wish.texture(rng, kind, 1.0) for _ in range(n)] for kind, n in made_of["textures"].items()
        }
        self._groups: dict[str, list[int]] = {}
        self._rng = rng
        for each in made_of["materials"]:
            self._add(**each)

    def _add(
        self, group: str, brightness: list[float], layers: list[list[Any]], count: int = 1, specular: float = 0.0
    ) -> None:
        """Materials that things may choose from, as palettes.yaml has them."""
        rng, (dark, bright) = self._rng, brightness
        for k in range(count):
            seeds = {kind: self._textures[kind][k % len(self._textures[kind])].seed for kind, _, _ in layers}
            chosen = tuple(
                Texture(kind, seeds[kind], tile * float(rng.uniform(0.8, 1.25)), _CONTRAST * contrast)
                for kind, tile, contrast in layers
            )
            self._groups.setdefault(group, []).append(len(self.materials))
            self.materials.append(Material(float(rng.uniform(dark, bright)), chosen, specular=specular))

    def choose(self, group: str) -> int:
        """Index of a material of the group."""
        members = self._groups[group]
        return members[int(self._rng.integers(len(members)))]


@cache
def _palettes() -> dict[str, dict[str, Any]]:
    return dict(yaml.safe_load(Path(__file__).with_name("palettes.yaml").read_text(encoding="utf-8")))
