"""A table of precomputed text embeddings: queries without weights, for the words that it holds."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Self

import torch

from liftcore.errors import InvalidQuery, InvalidTable
from liftcore.io.safetensors_file import check_header
from liftcore.query.encoders.words import nearest, plain

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from torch import Tensor

_HALF = re.compile("[\ud800-\udfff]")  # half a surrogate pair, which UTF-8 cannot carry


class TableEncoder:
    """Looks words up; cases, ``_`` for a space and a leading article make no difference.

    Args:
        name: what to call the table in messages.
        words: n words, one a row.
        embeddings: [n, F] f16 or f32, finite rows of any length above zero.

    Raises:
        InvalidTable: shapes that do not fit, rows that are zero or not finite, no words.
    """

    def __init__(self, name: str, words: Sequence[str], embeddings: Tensor) -> None:
        if embeddings.ndim != 2 or not words or embeddings.shape[0] != len(words) or embeddings.shape[1] == 0:
            raise InvalidTable(
                name,
                expected="embeddings [n, F] with n words",
                got=f"shape {str(list(embeddings.shape))[:80]} with {len(words)} words",
            )
        wide = embeddings.to(torch.float32)
        lengths = torch.linalg.vector_norm(wide, dim=1, keepdim=True)
        bad = (~torch.isfinite(lengths[:, 0])) | (lengths[:, 0] == 0)
        if bool(bad.any()):
            row = int(bad.nonzero()[0, 0])
            raise InvalidTable(
                name, expected="finite rows with a direction", got=f"row {row} ({words[row][:80]!r}) has none"
            )
        self.name = name
        self.words = tuple(words)
        self.channels = int(embeddings.shape[1])
        self._unit = wide / lengths
        # The first of two equal words wins: reversed, so that it is written last.
        self._rows = {plain(word): row for row, word in reversed(list(enumerate(words)))}

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open ``embeddings`` [n, F] f16 or f32 with metadata ``words`` (a JSON list of n strings).

        Raises:
            InvalidTable: no such file, or not a table.
        """
        from safetensors import SafetensorError, safe_open

        name = f"text table {path.name}"
        if not path.is_file():
            raise InvalidTable(name, expected="a file", got=f"nothing at {path}")
        expected = "a safetensors file with embeddings and words"
        check_header(path, name, InvalidTable, expected=expected)
        try:
            with safe_open(str(path), framework="pt") as handle:
                embeddings = handle.get_tensor("embeddings")
                words = json.loads((handle.metadata() or {}).get("words", "null"))
        except (SafetensorError, OSError, ValueError, RecursionError) as error:
            raise InvalidTable(name, expected=expected, got=str(error)[:120]) from None
        if not isinstance(words, list) or not all(isinstance(word, str) and not _HALF.search(word) for word in words):
            raise InvalidTable(name, expected="metadata words, a JSON list of strings", got="none")
        if embeddings.dtype not in (torch.float16, torch.float32):
            raise InvalidTable(name, expected="float16 or float32", got=str(embeddings.dtype).removeprefix("torch."))
        return cls(name, words, embeddings)

    def encode(self, texts: Sequence[str]) -> Tensor:
        """n words -> [n, F] f32 unit rows.

        Raises:
            InvalidQuery: a word that the table lacks; the error names the nearest ones.
        """
        return self._unit[[self._row(text) for text in texts]]

    def _row(self, text: str) -> int:
        row = self._rows.get(plain(text))
        if row is None:
            raise InvalidQuery(
                "text",
                expected=f"one of the {len(self.words)} words of {self.name}",
                got=repr(text),
                hint=nearest(text, self._rows),
            )
        return row
