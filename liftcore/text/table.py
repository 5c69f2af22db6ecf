"""Public: a table of precomputed text embeddings, for queries in its words without weights."""

import json
import re
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np

from liftcore.errors import InvalidQuery, InvalidTable, reading
from liftcore.io.npy import as_floats
from liftcore.io.safetensors_file import check_arrays, check_header, map_tensors
from liftcore.runtime.one_line import one_line
from liftcore.text import check_texts
from liftcore.text.wording import SUGGESTED, Vocabulary, normalize_text

__all__ = ["TableEncoder", "Vocabulary"]
_HALF = re.compile("[\ud800-\udfff]")  # half a surrogate pair, which UTF-8 cannot carry
_ERROR_CHARACTERS = 200  # of an unknown word in an error
EXPECTED = "a text table: safetensors with embeddings [n, F] and metadata words, a JSON list of n strings"


class TableEncoder:
    """Encoder that looks words up, without regard to case, ``_`` for a space and a leading article.

    Args:
        name: name of the table in messages.
        words: n words, one a row.
        embeddings: [n, F] f16 or f32, finite rows of any length above zero.

    Raises:
        InvalidTable: shapes that do not match, rows that are zero or not finite, or no words.
    """

    def __init__(self, name: str, words: Sequence[str], embeddings: np.ndarray) -> None:
        if embeddings.ndim != 2 or not words or len(embeddings) != len(words) or embeddings.shape[1] == 0:
            got = f"shape {str(list(embeddings.shape))[:80]} with {len(words)} words"
            raise InvalidTable(name, expected="embeddings [n, F] with n words", got=got)
        wide = np.asarray(embeddings, np.float64)
        lengths = np.linalg.norm(wide, axis=1, keepdims=True)
        bad = np.flatnonzero(~np.isfinite(lengths) | (lengths == 0))
        if len(bad):
            got = f"row {bad[0]} ({words[bad[0]][:80]!r}), which is zero or not finite"
            raise InvalidTable(name, expected="finite rows above zero length", got=got)
        self.name = name
        self.words = tuple(words)
        self.channels = int(embeddings.shape[1])
        self.embeddings = (wide / lengths).astype(np.float32)  # [n, F], unit rows of the words
        # Of two equal words the first one counts, so the order is reversed and the first is written last.
        self._rows = {normalize_text(word): row for row, word in reversed(list(enumerate(words)))}

    def __repr__(self) -> str:
        return one_line(self, repr(self.name), f"{len(self.words)} words", f"{self.channels} channels")

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open ``embeddings`` [n, F] f16 or f32 with metadata ``words`` (a JSON list of n strings)."""
        from liftcore.io.kinds import wrong_kind  # imported late: it loads readers of all kinds, for errors alone

        name = f"text table {path.name}"
        if not path.is_file():
            raise InvalidTable(name, expected="a file", got=f"nothing at {path}")
        try:
            with reading(name, InvalidTable, EXPECTED):
                check_header(path)
                tensors, metadata = map_tensors(path)
                if "embeddings" not in tensors:
                    raise ValueError(f"{EXPECTED}, got no embeddings")
                return cls.of(name, metadata.get("words", "null"), tensors["embeddings"])
        except InvalidTable as error:
            raise wrong_kind(path, "table", InvalidTable, argument=name, expected=EXPECTED) or error from None

    @classmethod
    def of(cls, name: str, words: str, embeddings: np.ndarray) -> Self:
        """Create a table from the words of a file, a JSON list of n strings, and embeddings [n, F] of any floats."""
        with reading(name, InvalidTable, "metadata words, a JSON list of strings"):
            word_list = json.loads(words)
            if not isinstance(word_list, list) or not all(
                isinstance(word, str) and not _HALF.search(word) for word in word_list
            ):
                raise ValueError(repr(words[:80]))
            check_arrays({"embeddings": embeddings}, {"embeddings": ("f2 f4 V2", "n F")})
        return cls(name, word_list, as_floats(embeddings))

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        """Encode n words as [n, F] f32 unit rows."""
        check_texts(texts)
        rows = [self._rows.get(normalize_text(text)) for text in texts]
        if None in rows:
            raise self.refusal(texts[rows.index(None)])
        return self.embeddings[rows]

    @cached_property
    def vocabulary(self) -> Vocabulary:
        """Vocabulary that finds these words in typed text."""
        return Vocabulary(self.words)

    def refusal(self, text: str, scene_words: Sequence[str] = ()) -> InvalidQuery:
        """Return the error for a word that is not in the table, with suggestions.

        Args:
            scene_words: words of objects in the scene, which come first among suggestions of their kind, and are the
                only suggestions if no word is near.
        """
        near = self.vocabulary.nearest(text, first=scene_words)
        suggestions = list(scene_words[:SUGGESTED])
        in_scene = f"in this scene: {', '.join(suggestions)}" if suggestions else ""
        hint = f"nearest: {', '.join(near)}" if near else in_scene
        expected, got = f"one of the {len(self.words)} words of {self.name}", repr(text[:_ERROR_CHARACTERS])
        return InvalidQuery("text", expected=expected, got=got, hint=hint, nearest=near or suggestions)


def own_words(words: Sequence[str], embeddings: np.ndarray | None) -> TableEncoder | None:
    """Return the table that is stored in a lift, None if there is no such table."""
    return None if embeddings is None or not words else TableEncoder("the lift's own words", words, embeddings)
