"""The start of a safetensors file, looked at before a reader parses it."""

from __future__ import annotations

import json
import struct
from contextlib import suppress
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

    from liftcore.errors import InvalidInput

MAX_HEADER_BYTES = 32 * 1024 * 1024
_START = 9  # bytes: the header's length, and the brace that it begins with


def check_header(path: Path, name: str, fault: type[InvalidInput], *, expected: str, hint: str = "") -> None:
    """Refuse what is no safetensors file, headers of absurd length, and those that say a name twice.

    Args:
        path: the file.
        name: what errors call it.
        fault: what is raised.
        expected: what the file should have been.
        hint: how to make one.
    """
    try:
        with path.open("rb") as handle:
            start = handle.read(_START)
    except OSError as error:
        got = "a folder" if path.is_dir() else f"a file that does not open ({error.strerror})"
        raise fault(name, expected=expected, got=got, hint=hint) from None
    length = struct.unpack("<Q", start[:8])[0] if len(start) == _START else 0
    # A header may be as long as such a signature reads as a number: 640 bytes are b"\x80\x02". Then it is JSON.
    signed = start[:2] in (b"PK", b"\x80\x02") and not (start[8:] == b"{" and length <= MAX_HEADER_BYTES)
    if signed or path.suffix.lower() in (".pt", ".pth", ".pkl"):
        raise fault(
            name,
            expected=expected,
            got="a Python pickle or a zip, which may run code when it is opened",
            hint="save its arrays as .npy files ('splatlift pack npy' makes packs of those), or as safetensors",
        )
    if len(start) < _START or start[8:] != b"{":
        got = f"a file that begins with {start!r}" if start else "an empty file"
        raise fault(name, expected=expected, got=got, hint=hint)
    if length > MAX_HEADER_BYTES:
        raise fault(name, expected=f"a header of at most {MAX_HEADER_BYTES} bytes", got=f"{length} bytes")
    _check_names(path, name, fault, length)


def _check_names(path: Path, name: str, fault: type[InvalidInput], length: int) -> None:
    """Refuse headers that say a name twice, of which each reader believes another; safetensors refuses bad JSON."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len(dict(pairs)) < len(pairs):
            raise fault(name, expected="a header that says each name once", got="one twice")
        return dict(pairs)

    with path.open("rb") as handle, suppress(ValueError, RecursionError):
        handle.seek(8)
        json.loads(handle.read(length), object_pairs_hook=once)
