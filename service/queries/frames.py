"""What goes through the pipes of the query worker: a line of JSON, then as many bytes as it says."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import IO, Any


@dataclass(frozen=True)
class Frame:
    """A message with an optional picture or array."""

    header: dict[str, Any]
    body: bytes = field(default=b"", repr=False)


def write_frame(out: IO[bytes], frame: Frame) -> None:
    """Send one message."""
    line = json.dumps({"bytes": len(frame.body), "header": frame.header}, allow_nan=False)
    out.write(line.encode() + b"\n")
    out.write(frame.body)
    out.flush()


def read_frame(source: IO[bytes]) -> Frame | None:
    """The next message, None when the other side is gone."""
    line = source.readline()
    if not line.endswith(b"\n"):
        return None
    message = json.loads(line)
    body = source.read(message["bytes"])
    return Frame(message["header"], body) if len(body) == message["bytes"] else None
