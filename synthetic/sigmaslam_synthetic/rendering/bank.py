"""A bank of textures that renews itself while training goes on."""

from collections import OrderedDict

import numpy as np

from sigmaslam_synthetic.rendering.textures import KINDS, check_kind, paint


class TextureBank:
    """Random-access sequence of textures, a pure function of (seed, index).

    The bank has `count` places; index i asks for place i % count, so that `count` neighbouring indices see as many
    different textures. The texture of a place is replaced after `uses` uses, one place after another, so that painting
    takes its time evenly. Only the last 2 `count` textures asked for are kept; others are painted again.

    Args:
        seed: of all textures.
        kinds: as `textures.paint` takes them; each texture's is drawn at random. One given twice is drawn twice as
            often.
        size: side of the square textures, pixels.
        count: places.
        uses: how often a texture is used before it is replaced (those of the beginning, less).
    Raises:
        ValueError: a kind is unknown, there is none, or `count` or `uses` is below 1.
    """

    def __init__(
        self, seed: int, kinds: tuple[str, ...] = ("leaves",), size: int = 448, count: int = 16, uses: int = 32
    ) -> None:
        if not kinds:
            raise ValueError(f"there are no kinds of textures: give one or more of {', '.join(KINDS)}")
        for kind in kinds:
            check_kind(kind)
        if count < 1 or uses < 1:
            raise ValueError(f"count is {count} and uses is {uses}; both must be at least 1")
        self.seed, self.kinds, self.size, self.count, self.uses = seed, kinds, size, count, uses
        self._kept: OrderedDict[int, np.ndarray] = OrderedDict()

    def key(self, index: int) -> int:
        """Number of the texture that this index gets; equal numbers are equal textures."""
        turn, place = divmod(index, self.count)
        return (turn + place * self.uses // self.count) // self.uses * self.count + place

    def texture(self, index: int) -> np.ndarray:
        """The texture of that index, (size, size) uint8, not writeable."""
        key = self.key(index)
        if key not in self._kept:
            rng = np.random.default_rng((self.seed, 0, key))
            kind = self.kinds[int(rng.integers(len(self.kinds)))]
            self._kept[key] = paint(kind, self.size, int(rng.integers(2**63)))
            if len(self._kept) > 2 * self.count:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]
