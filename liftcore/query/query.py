"""What is asked: words and examples, for and against, and how to find where they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from liftcore.errors import InvalidQuery
from liftcore.query.example import Example
from liftcore.query.threshold import check_method

Term = str | Example  # a text, or an example
KEPT = ("all", "largest")
MOST_TERMS = 64  # for and against together


@dataclass(frozen=True)
class Query:
    """Positives and negatives make one query; each is a text or an example.

    Texts need an encoder of the lift's text space, examples need none. The scores are defined in
    ``liftcore.query.scores.combine``.

    Raises:
        InvalidQuery: no positive, too many terms, an unknown threshold, or instances that it cannot count.
    """

    positives: tuple[Term, ...]
    negatives: tuple[Term, ...] = ()
    threshold: str | float = "auto"  # a method of liftcore.query.threshold, or a number on the scores
    instances: int | None = None  # how many there are, where the user knows
    keep: str = "all"  # of the objects that are found: all, or the largest alone
    names: tuple[str, ...] = ()  # what errors call each of the terms; () = what they are themselves

    def __post_init__(self) -> None:
        if not self.positives:
            raise InvalidQuery(
                "query", expected="a text or an example of what to look for",
                got="only what it is not" if self.negatives else "neither",
                hint="say what to look for, too" if self.negatives else "",
            )  # fmt: skip
        count = len(self.positives) + len(self.negatives)
        if count > MOST_TERMS:
            raise InvalidQuery("query", expected=f"at most {MOST_TERMS} texts and examples", got=str(count))
        if self.keep not in KEPT:
            raise InvalidQuery("keep", expected=f"one of {', '.join(KEPT)}", got=repr(self.keep))
        check_method(self.threshold, self.instances)

    @property
    def terms(self) -> tuple[Term, ...]:
        """Positives, then negatives."""
        return (*self.positives, *self.negatives)


def texts_of(terms: Sequence[Term]) -> list[str]:
    """The texts among the terms, in their order."""
    return [term for term in terms if isinstance(term, str)]
