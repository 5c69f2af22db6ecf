"""A text encoder that remembers the texts it read last: people ask for a mask after they asked for the words."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor

    from liftcore.query.encoders import TextEncoder

REMEMBERED = 1_024  # texts; two megabytes at 512 channels


class RememberingEncoder:
    """Another encoder, asked only for texts that are not among the last ones (``TextEncoder``)."""

    def __init__(self, encoder: TextEncoder, size: int = REMEMBERED) -> None:
        self._encoder = encoder
        self._size = size
        self._rows: OrderedDict[str, Tensor] = OrderedDict()

    @property
    def name(self) -> str:
        """The other encoder's."""
        return self._encoder.name

    @property
    def channels(self) -> int:
        """The other encoder's."""
        return self._encoder.channels

    def encode(self, texts: Sequence[str]) -> Tensor:
        """n texts -> [n, F] f32 unit rows; errors are the other encoder's, and are not remembered."""
        new = [text for text in dict.fromkeys(texts) if text not in self._rows]
        rows = dict(zip(new, self._encoder.encode(new), strict=True)) if new else {}
        for text in texts:
            if text in self._rows:
                rows[text] = self._rows[text]
                self._rows.move_to_end(text)
        for text in new:
            self._rows[text] = rows[text]
        while len(self._rows) > self._size:
            self._rows.popitem(last=False)
        return torch.stack([rows[text] for text in texts]) if texts else torch.empty(0, self.channels)
