"""A body on its way to a file: decompressed, counted and digested as it comes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Self

from service.errors import TooLarge
from service.uploads.decoding import Coding, Decoding
from service.wire import AssetKind

STEP = 4 << 20  # bytes of content between two looks at what may still be stored
HINTS = {AssetKind.FEATURES: "several feature packs may make one lift, so features can be cut"}


def require_size(kind: AssetKind, count: int, limit: int) -> None:
    """See that a body of so many bytes may come.

    Raises:
        TooLarge: it may not.
    """
    if count > limit:
        raise TooLarge(
            "body", expected=f"at most {limit} bytes, compressed or not", got="more", hint=HINTS.get(kind, "")
        )


class Intake:
    """Writes a body to a draft, never more than ``limit`` bytes of it before or after decompression.

    Args:
        draft: the file.
        kind: what it is to be.
        limit: what the operator allows.
        coding: how the body is compressed.
        permit: called every few MiB of content with what there will be of it and what comes now, in bytes; raises
            when that may not be stored.
    """

    def __init__(
        self, draft: Path, kind: AssetKind, *, limit: int, coding: Coding | None, permit: Callable[[int, int], None]
    ) -> None:
        self._kind = kind
        self._permit = permit
        self._permitted = 0
        self._file = draft.open("wb")
        self._limit = limit
        self._received = 0
        self._written = 0
        self._digest = hashlib.sha256()
        self._decoding = None if coding is None else Decoding(coding)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._file.close()

    def feed(self, chunk: bytes) -> None:
        """Take the next bytes of the body.

        Raises:
            TooLarge: there are more than may come, or come out.
            InvalidEncoding: they do not decompress.
            ServiceError: as `permit` does.
        """
        self._received += len(chunk)
        require_size(self._kind, self._received, self._limit)
        for content in (chunk,) if self._decoding is None else self._decoding.feed(chunk):
            self._write(content)

    def finish(self) -> str:
        """The sha256 of the content, in hex; call once after the last byte.

        Raises:
            InvalidEncoding: a compressed body ended early.
        """
        if self._decoding is not None:
            self._decoding.finish()
        self._file.flush()
        return self._digest.hexdigest()

    def _write(self, content: bytes) -> None:
        self._written += len(content)
        require_size(self._kind, self._written, self._limit)
        if self._written > self._permitted:
            self._permit(self._written, len(content))
            self._permitted = self._written + STEP
        self._digest.update(content)
        self._file.write(content)
