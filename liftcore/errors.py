"""Public: errors that users can fix, with a message for them::

    SplatliftError                 every error that the user can fix
    ├── InvalidInput               a file or value is malformed      -> exit 2, HTTP 422
    │   ├── InvalidSplats
    │   ├── InvalidCameras
    │   ├── InvalidFeatures
    │   ├── InvalidMasks
    │   ├── InvalidPhotos
    │   ├── InvalidLift
    │   ├── InvalidSettings
    │   └── InvalidQuery           (an unknown word, a view that is not there)
    │       └── InvalidTable       (the words themselves)
    ├── NotFound                   a name does not exist             -> exit 2, HTTP 404
    └── Unavailable                a capability is missing here      -> exit 2, HTTP 422 (weights, encoders)

Every error names the argument, the expected value and the actual one, and has a hint.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial

__all__ = [
    "InvalidCameras", "InvalidFeatures", "InvalidInput", "InvalidLift", "InvalidMasks", "InvalidPhotos",
    "InvalidQuery", "InvalidSettings", "InvalidSplats", "InvalidTable", "NotFound", "SplatliftError", "Unavailable",
]  # fmt: skip


class SplatliftError(Exception):
    """An error whose message is written for the user.

    Args:
        argument: the argument, file or field at fault, by the name that the user knows.
        expected: a valid value.
        got: the actual value.
        hint: a remedy; empty if the first three are enough.
        nearest: for an unknown word, known words near to it, the likeliest first; None for
            any other error.
    """

    kind = "error"  # stable slug: the last part of the problem type in HTTP answers

    def __init__(
        self, argument: str, *, expected: str, got: str, hint: str = "", nearest: Sequence[str] | None = None
    ) -> None:
        self.argument = argument
        self.expected = expected
        self.got = got
        self.hint = hint
        self.nearest = None if nearest is None else tuple(nearest)
        super().__init__(argument, expected, got, hint)

    def __str__(self) -> str:
        """One line: ``argument: expected ..., got ...; hint``."""
        line = f"{self.argument}: expected {self.expected}, got {self.got}"
        line = f"{line}; {self.hint}" if self.hint else line
        return " ".join(line.split())

    def __reduce__(self) -> tuple[object, tuple[()]]:
        # Errors are pickled between processes (jobs run in a child), which keyword-only arguments prevent by default.
        names = {"expected": self.expected, "got": self.got, "hint": self.hint, "nearest": self.nearest}
        return partial(type(self), self.argument, **names), ()


MOST_SEEN = 1000  # characters of what a reader saw, such as two paths


@contextmanager
def reading(source: object, error: type[SplatliftError], expected: str, hint: str = "") -> Iterator[None]:
    """Raise ``error`` about a file or a value for what its reader raises.

    A reader's ``ValueError`` says ``X, got Y; do W``. Where it says less, ``expected`` and ``hint`` are taken.
    """
    try:
        yield
    except SplatliftError:
        raise
    except OSError as fault:
        got = f"a file that does not open ({fault.strerror or fault})"[:160]
        raise error(str(source), expected=expected, got=got, hint=hint) from None
    except (ValueError, TypeError, LookupError, OverflowError, RecursionError, EOFError, SyntaxError) as fault:
        text = f"no {fault}" if isinstance(fault, KeyError) else str(fault)
        expectation, separator, got = text.partition(", got ")
        got, _, remedy = got.partition("; ") if separator else (expectation, "", "")
        raise error(
            str(source), expected=expectation if separator else expected, got=got[:MOST_SEEN], hint=remedy or hint
        ) from None


@contextmanager
def naming(source: object) -> Iterator[None]:
    """Name a file in errors about its content that do not name it."""
    try:
        yield
    except SplatliftError as error:
        if str(source) not in error.argument:
            error.argument = f"{source} {error.argument}"
        raise


class InvalidInput(SplatliftError):
    """A file or a value is malformed."""

    kind = "invalid-input"


class InvalidSplats(InvalidInput):
    """A splat file or its content is malformed."""

    kind = "invalid-splats"


class InvalidCameras(InvalidInput):
    """A camera file or its content is malformed or not supported."""

    kind = "invalid-cameras"


class InvalidFeatures(InvalidInput):
    """A feature pack or its content is malformed, or does not fit the scene."""

    kind = "invalid-features"


class InvalidMasks(InvalidInput):
    """Masks of an evaluation, or their content, are malformed."""

    kind = "invalid-masks"


class InvalidPhotos(InvalidInput):
    """A zip of photos, or one of them, is malformed."""

    kind = "invalid-photos"


class InvalidLift(InvalidInput):
    """A lift file is malformed, or its inputs moved or changed."""

    kind = "invalid-lift"


class InvalidSettings(InvalidInput):
    """A setting has an unknown name or a value out of range."""

    kind = "invalid-settings"


class InvalidQuery(InvalidInput):
    """A query cannot be answered as asked."""

    kind = "invalid-query"


class InvalidTable(InvalidQuery):
    """A table of text embeddings is malformed."""

    kind = "invalid-table"


class NotFound(SplatliftError, KeyError):
    """A name does not exist; a KeyError too, so that mappings may raise it."""

    kind = "not-found"


class Unavailable(SplatliftError):
    """A capability is missing on this machine: weights, an encoder, a device."""

    kind = "unavailable"
