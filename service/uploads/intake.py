"""A body on its way to a file: decompressed, counted and digested as it comes."""

from __future__ import annotations

import hashlib
import zlib
from pathlib import Path
from typing import Self

from service.errors import InvalidEncoding, TooLarge, UnsupportedEncoding

WINDOW = 31  # zlib's name for "a gzip header and a 32 KiB window"
PIECE = 1 << 20  # bytes that one step of decompression may give


def gzipped(content_encoding: str) -> bool:
    """Whether a Content-Encoding says gzip.

    Raises:
        UnsupportedEncoding: it says something else.
    """
    name = content_encoding.strip().lower()
    if name in ("", "identity"):
        return False
    if name in ("gzip", "x-gzip"):
        return True
    raise UnsupportedEncoding(
        "Content-Encoding", expected="gzip, or none", got=name[:40], hint="zstd is not supported yet"
    )


class Intake:
    """Writes a body to a draft, never more than ``limit`` bytes of it before or after decompression."""

    def __init__(self, draft: Path, *, limit: int, gzip: bool) -> None:
        self._file = draft.open("wb")
        self._limit = limit
        self._received = 0
        self._written = 0
        self._digest = hashlib.sha256()
        self._gunzip = zlib.decompressobj(WINDOW) if gzip else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._file.close()

    def feed(self, chunk: bytes) -> None:
        """Take the next bytes of the body."""
        self._received += len(chunk)
        self._check(self._received)
        if self._gunzip is None:
            self._write(chunk)
        else:
            self._inflate(chunk)

    def finish(self) -> str:
        """The sha256 of the content, in hex; call once after the last byte.

        Raises:
            InvalidEncoding: the gzip stream ended early.
        """
        if self._gunzip is not None and not self._gunzip.eof:
            raise InvalidEncoding("body", expected="a whole gzip stream", got="one that ends early")
        self._file.flush()
        return self._digest.hexdigest()

    def _inflate(self, chunk: bytes) -> None:
        assert self._gunzip is not None
        try:
            while chunk:
                if self._gunzip.eof:  # gzip files may be concatenated
                    self._gunzip = zlib.decompressobj(WINDOW)
                self._write(self._gunzip.decompress(chunk, PIECE))
                chunk = self._gunzip.unconsumed_tail or self._gunzip.unused_data
        except zlib.error as error:
            raise InvalidEncoding("body", expected="gzip, as Content-Encoding says", got=str(error)) from None

    def _write(self, content: bytes) -> None:
        self._written += len(content)
        self._check(self._written)
        self._digest.update(content)
        self._file.write(content)

    def _check(self, count: int) -> None:
        if count > self._limit:
            raise TooLarge(
                "body", expected=f"at most {self._limit} bytes, compressed or not", got="more",
                hint="several feature packs may make one lift, so features can be cut",
            )  # fmt: skip
