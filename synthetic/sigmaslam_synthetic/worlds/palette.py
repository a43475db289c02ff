"""The materials of one scene, made of few textures in many sizes and greys."""

from collections.abc import Mapping

import numpy as np

from sigmaslam_synthetic.scene import Material, Texture
from sigmaslam_synthetic.worlds.episode import Wish

# Of real streets more is in light and shade than in texture: measured by gradients against KITTI.
_CONTRAST = 0.65


class Palette:
    """Materials by number.

    Args:
        rng: source of the choice of textures.
        wish: whose bank they come from.
        counts: how many textures of each kind the scene has.
    """

    def __init__(self, rng: np.random.Generator, wish: Wish, counts: Mapping[str, int]) -> None:
        self.materials: list[Material] = []
        self._textures = {kind: [wish.texture(rng, kind, 1.0) for _ in range(n)] for kind, n in counts.items()}
        self._groups: dict[str, list[int]] = {}
        self._rng = rng

    def add(
        self,
        group: str,
        brightness: tuple[float, float],
        *layers: tuple[str, float, float],
        count: int = 1,
        specular: float = 0.0,
    ) -> None:
        """Materials that things may choose from.

        Args:
            group: its name.
            brightness: range of the mean albedo.
            layers: one or two of (kind of texture, tile in metres, contrast).
            count: how many.
            specular: strength of highlights.
        """
        rng = self._rng
        for k in range(count):
            chosen = tuple(
                Texture(kind, self._pick(kind, k), tile * float(rng.uniform(0.8, 1.25)), _CONTRAST * contrast)
                for kind, tile, contrast in layers
            )
            self._groups.setdefault(group, []).append(len(self.materials))
            self.materials.append(Material(float(rng.uniform(*brightness)), chosen, specular=specular))

    def choose(self, group: str) -> int:
        """Index of a material of the group."""
        members = self._groups[group]
        return members[int(self._rng.integers(len(members)))]

    def _pick(self, kind: str, k: int) -> int:
        return self._textures[kind][k % len(self._textures[kind])].seed
