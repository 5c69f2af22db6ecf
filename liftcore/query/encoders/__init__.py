"""Text encoders behind one protocol: words in, unit vectors out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from liftcore.errors import InvalidQuery
from liftcore.query.encoders.specs import ENCODER_SPECS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor


class TextEncoder(Protocol):
    """Maps texts into the space of the lifted features."""

    @property
    def name(self) -> str:
        """What the encoder is, for messages and metadata."""
        ...

    @property
    def channels(self) -> int:
        """F, the length of its vectors."""
        ...

    def encode(self, texts: Sequence[str]) -> Tensor:
        """n texts -> [n, F] f32 with unit rows.

        Raises:
            InvalidQuery: a text that the encoder cannot read (a word that a table lacks, an empty text).
        """
        ...


def open_encoder(spec: str) -> TextEncoder:
    """Open a text encoder by its specification.

    Args:
        spec: ``table:FILE`` or a path ending in ``.safetensors`` (precomputed embeddings); ``minilm`` (a
            small sentence encoder, offline); ``open_clip:MODEL/TAG`` or ``open_clip:MODEL@FILE``.

    Raises:
        InvalidQuery: the specification is none of these, or a table is malformed.
        Unavailable: the encoder's weights are not on this machine.
    """
    kind, _, rest = spec.partition(":")
    # A bare path may hold a colon itself, so the suffix is asked first.
    if kind != "table" and spec.endswith(".safetensors") and not spec.startswith("open_clip:"):
        kind, rest = "table", spec
    if kind == "table" and rest:
        from liftcore.query.encoders.table import TableEncoder

        return TableEncoder.open(Path(rest))
    if spec == "minilm":
        from liftcore.query.encoders.minilm import MiniLmEncoder

        return MiniLmEncoder()
    if kind == "open_clip" and rest:
        from liftcore.query.encoders.open_clip import OpenClipEncoder

        return OpenClipEncoder.open(rest)
    raise InvalidQuery("encoder", expected=f"one of {', '.join(ENCODER_SPECS)}", got=repr(spec))
