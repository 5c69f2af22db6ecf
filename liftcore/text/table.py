"""Public: a table of precomputed text embeddings, for queries in its words without weights."""

import json
import re
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from liftcore.errors import InvalidInput, InvalidQuery, InvalidTable
from liftcore.io.safetensors_file import check_header, map_tensors
from liftcore.runtime.one_line import one_line
from liftcore.text import check_texts
from liftcore.text.wording import SUGGESTED, Vocabulary, plain

__all__ = ["TableEncoder", "Vocabulary"]
_HALF = re.compile("[\ud800-\udfff]")  # half a surrogate pair, which UTF-8 cannot carry
TABLE = "a text table: safetensors with embeddings [n, F] and metadata words, a JSON list of n strings"
_SHOWN = 200  # characters of a word that a table lacks, in the error
EXPECTED = "a safetensors file with embeddings and words"


def check_table(path: Path) -> None:
    """Look at the header of a table, and at nothing else of it.

    Raises:
        InvalidInput: it is none.
    """
    from safetensors import SafetensorError, safe_open

    from liftcore.io.kinds import wrong_kind

    if error := wrong_kind(path, "table", InvalidInput, expected=TABLE):
        raise InvalidInput("encoder", expected=error.expected, got=f"{error.got} at {path}", hint=error.hint)
    try:
        check_header(path, str(path), InvalidInput, expected=TABLE)
        handle: Any
        with safe_open(str(path), framework="np") as handle:
            shape = handle.get_slice("embeddings").get_shape()
            words = json.loads((handle.metadata() or {}).get("words", "null"))
    except InvalidInput as error:
        raise InvalidInput("encoder", expected=error.expected, got=f"{error.got} at {path}") from None
    except (SafetensorError, OSError, ValueError, RecursionError) as error:
        raise InvalidInput("encoder", expected=TABLE, got=f"{str(error)[:120]} in {path}") from None
    if len(shape) != 2 or not isinstance(words, list) or len(words) != shape[0]:
        count = f"{len(words)} words" if isinstance(words, list) else "no words"
        raise InvalidInput("encoder", expected=TABLE, got=f"{path} with {count} and embeddings {shape}")


class TableEncoder:
    """Looks words up; cases, ``_`` for a space and a leading article make no difference.

    Args:
        name: what to call the table in messages.
        words: n words, one a row.
        embeddings: [n, F] f16 or f32, finite rows of any length above zero.

    Raises:
        InvalidTable: shapes that do not fit, rows that are zero or not finite, no words.
    """

    def __init__(self, name: str, words: Sequence[str], embeddings: np.ndarray) -> None:
        if embeddings.ndim != 2 or not words or len(embeddings) != len(words) or embeddings.shape[1] == 0:
            got = f"shape {str(list(embeddings.shape))[:80]} with {len(words)} words"
            raise InvalidTable(name, expected="embeddings [n, F] with n words", got=got)
        wide = np.asarray(embeddings, np.float64)
        lengths = np.linalg.norm(wide, axis=1, keepdims=True)
        bad = np.flatnonzero(~np.isfinite(lengths) | (lengths == 0))
        if len(bad):
            got = f"row {bad[0]} ({words[bad[0]][:80]!r}) has none"
            raise InvalidTable(name, expected="finite rows with a direction", got=got)
        self.name = name
        self.words = tuple(words)
        self.channels = int(embeddings.shape[1])
        self._unit = (wide / lengths).astype(np.float32)
        # The first of two equal words wins: reversed, so that it is written last.
        self._rows = {plain(word): row for row, word in reversed(list(enumerate(words)))}

    def __repr__(self) -> str:
        return one_line(self, repr(self.name), f"{len(self.words)} words", f"{self.channels} channels")

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open ``embeddings`` [n, F] f16 or f32 with metadata ``words`` (a JSON list of n strings).

        Raises:
            InvalidTable: no such file, or not a table.
        """
        from liftcore.io.kinds import wrong_kind  # here: most tables are ones, and this loads readers of all kinds

        name = f"text table {path.name}"
        if not path.is_file():
            raise InvalidTable(name, expected="a file", got=f"nothing at {path}")
        try:
            return cls._read(path, name)
        except InvalidTable as error:
            raise wrong_kind(path, "table", InvalidTable, argument=name, expected=EXPECTED) or error from None

    @classmethod
    def _read(cls, path: Path, name: str) -> Self:
        from safetensors import SafetensorError

        check_header(path, name, InvalidTable, expected=EXPECTED)
        try:
            tensors, metadata = map_tensors(path)
        except (SafetensorError, OSError, ValueError) as error:
            raise InvalidTable(name, expected=EXPECTED, got=str(error)[:120]) from None
        if "embeddings" not in tensors:
            raise InvalidTable(name, expected=EXPECTED, got="no embeddings")
        return cls.of(name, metadata.get("words", "null"), tensors["embeddings"])

    @classmethod
    def of(cls, name: str, words: str, embeddings: np.ndarray) -> Self:
        """A table as files hold it: ``words`` is a JSON list of n strings, ``embeddings`` [n, F] f16 or f32.

        Raises:
            InvalidTable: the words are no such list, or the embeddings do not fit them.
        """
        try:
            listed = json.loads(words)
        except (ValueError, RecursionError) as error:
            raise InvalidTable(name, expected="metadata words, a JSON list", got=str(error)[:120]) from None
        if not isinstance(listed, list) or not all(
            isinstance(word, str) and not _HALF.search(word) for word in listed
        ):
            raise InvalidTable(name, expected="metadata words, a JSON list of strings", got="none")
        if embeddings.dtype not in (np.float16, np.float32):
            raise InvalidTable(name, expected="float16 or float32", got=str(embeddings.dtype))
        return cls(name, listed, embeddings)

    @property
    def embeddings(self) -> np.ndarray:
        """[n, F] f32, the unit rows of the words."""
        return self._unit

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        """n words -> [n, F] f32 unit rows.

        Raises:
            InvalidQuery: a word that the table lacks; the error names the nearest ones.
        """
        check_texts(texts)
        return self._unit[[self._row(text) for text in texts]]

    def _row(self, text: str) -> int:
        row = self._rows.get(plain(text))
        if row is None:
            raise self.refusal(text)
        return row

    @cached_property
    def vocabulary(self) -> Vocabulary:
        """The words as people may type them."""
        return Vocabulary(self.words)

    def refusal(self, text: str, here: Sequence[str] = ()) -> InvalidQuery:
        """The error of a word that the table lacks, with words to ask for in its place.

        Args:
            here: words of what is in the scene, which come first of their kind, and alone where none is near.
        """
        near = self.vocabulary.nearest(text, first=here)
        some = list(here[:SUGGESTED])
        hint = f"nearest: {', '.join(near)}" if near else f"in this scene: {', '.join(some)}" if some else ""
        return InvalidQuery(
            "text", expected=f"one of the {len(self.words)} words of {self.name}", got=repr(text[:_SHOWN]), hint=hint,
            nearest=near or some,
        )  # fmt: skip


def own_words(words: Sequence[str], embeddings: np.ndarray | None) -> TableEncoder | None:
    """The table that a lift brings; None where it has none."""
    return None if embeddings is None or not words else TableEncoder("the lift's own words", words, embeddings)
