"""Compressed bodies: gzip and zstd, undone piece by piece, so that no bomb ever lies in memory.

What a decoder gives at once is bounded by what it is given: deflate makes at most 1,032 bytes of one, and a zstd
block of four bytes at most 128 KiB. So each coding has a size of piece of which 16 MiB come out at most.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import zstandard

from service.errors import InvalidEncoding, UnsupportedEncoding

GZIP_WINDOW = 31  # zlib's name for "a gzip header and a 32 KiB window"
ZSTD_WINDOW_BYTES = 8 << 20  # the largest that RFC 9659 lets a Content-Encoding ask for
MAX_MEMBERS = 1_000_000  # of a concatenated body; bgzip makes one of each 64 KiB


class Decoder(Protocol):
    """Undoes one member of a body: a gzip member or a zstd frame."""

    @property
    def eof(self) -> bool:
        """Whether the member has ended."""
        ...

    @property
    def unused_data(self) -> bytes:
        """What came after its end."""
        ...

    def decompress(self, data: bytes, /) -> bytes:
        """Take the next bytes."""
        ...


def _gzip() -> Callable[[], Decoder]:
    return partial(zlib.decompressobj, GZIP_WINDOW)


def _zstd() -> Callable[[], Decoder]:
    # Its tables are made once a body, and not once a frame.
    return zstandard.ZstdDecompressor(max_window_size=ZSTD_WINDOW_BYTES).decompressobj


@dataclass(frozen=True)
class Coding:
    """A way to compress a body."""

    name: str
    piece: int  # bytes that one step takes
    begin: Callable[[], Callable[[], Decoder]]  # for a body: what gives a decoder for each of its members


GZIP = Coding("gzip", 16 << 10, _gzip)
ZSTD = Coding("zstd", 512, _zstd)
CODINGS = {"": None, "identity": None, "gzip": GZIP, "x-gzip": GZIP, "zstd": ZSTD}


def coding_of(content_encoding: str) -> Coding | None:
    """The coding that a Content-Encoding names, None for none.

    Raises:
        UnsupportedEncoding: it names another, or several.
    """
    name = content_encoding.strip().lower()
    if name not in CODINGS:
        raise UnsupportedEncoding("Content-Encoding", expected="gzip, zstd, or none", got=name[:40])
    return CODINGS[name]


class Decoding:
    """A body of one or more members, one after the other."""

    def __init__(self, coding: Coding) -> None:
        self._coding = coding
        self._member = coding.begin()
        self._decoder = self._member()
        self._members = 1

    def feed(self, chunk: bytes) -> Iterator[bytes]:
        """What the next bytes of the body stand for, 16 MiB at most at a time.

        Raises:
            InvalidEncoding: they are not in the coding, ask for too large a window, or are too many members.
        """
        for first in range(0, len(chunk), self._coding.piece):
            rest = chunk[first : first + self._coding.piece]
            while rest:
                if self._decoder.eof:
                    self._next_member()
                yield self._decompress(rest)
                rest = self._decoder.unused_data if self._decoder.eof else b""

    def finish(self) -> None:
        """See that the body has ended.

        Raises:
            InvalidEncoding: its last member is cut short.
        """
        if not self._decoder.eof:
            raise self._refuse(f"a whole {self._coding.name} stream", "one that ends early")

    def _next_member(self) -> None:
        self._members += 1
        if self._members > MAX_MEMBERS:
            raise self._refuse(f"at most {MAX_MEMBERS} {self._coding.name} streams in a row", "more")
        self._decoder = self._member()

    def _decompress(self, piece: bytes) -> bytes:
        try:
            return self._decoder.decompress(piece)
        except (zlib.error, zstandard.ZstdError) as error:
            hint = f"a window of at most {ZSTD_WINDOW_BYTES >> 20} MiB" if "memory" in str(error) else ""
            raise self._refuse(f"{self._coding.name}, as Content-Encoding says", str(error), hint) from None

    def _refuse(self, expected: str, got: str, hint: str = "") -> InvalidEncoding:
        return InvalidEncoding("body", expected=expected, got=got, hint=hint)
