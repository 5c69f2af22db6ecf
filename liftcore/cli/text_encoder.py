"""Which text encoder a command opens: the one that is named, else the one of the lift's text space."""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore.errors import InvalidQuery
from liftcore.query.encoders.specs import NO_WORDS

if TYPE_CHECKING:
    import argparse


def encoder_spec(options: argparse.Namespace, text_space: str, hint: str = "") -> str:
    """The specification of the encoder that ``--table`` or ``--encoder`` names, else of the lift's text space.

    Args:
        hint: what else the command can do.

    Raises:
        InvalidQuery: neither is given, and the lift's text space names no encoder.
    """
    if options.table:
        return f"table:{options.table}"
    spec = options.encoder or text_space
    if spec in ("", NO_WORDS):
        space = f"is {NO_WORDS!r}: its features share no space with words" if spec else "is not named"
        raise InvalidQuery(
            "encoder", expected="--table FILE or --encoder NAME", got=f"neither, and the lift's text space {space}",
            hint=hint,
        )  # fmt: skip
    return spec
