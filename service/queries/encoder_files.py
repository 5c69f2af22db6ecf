"""The files that text encoders are read from, looked at before the service starts.

The process that queries opens an encoder at the first question to it, and an error is then told to whoever asked,
who can do nothing about it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from liftcore.errors import InvalidInput
from liftcore.io.safetensors_file import check_header
from liftcore.query.text import ENCODER_SPECS
from service.errors import Misconfigured
from service.settings import ServiceSettings, encoder_file, encoder_label

TABLE = "a text table: safetensors with embeddings [n, F] and metadata words, a JSON list of n strings"


def require_encoder_files(settings: ServiceSettings) -> None:
    """See that every file that a text encoder of the settings names is there, and that tables look like ones.

    Raises:
        Misconfigured: there is no such encoder, a file is missing or does not open, or a table is none. The setting
            is named.
    """
    named = {"encoder": settings.encoder}
    named |= {f"text_spaces, {space!r}": spec for space, spec in settings.text_spaces.items()}
    for argument, spec in named.items():
        path = encoder_file(spec)
        if path is None and spec != "minilm" and not spec.startswith("open_clip:"):
            raise Misconfigured(argument, expected=f"one of {', '.join(ENCODER_SPECS)}", got=repr(spec))
        if path is not None:
            _require_readable(argument, path)
            if encoder_label(spec) == "table":
                _require_table(argument, path)


def _require_readable(argument: str, path: Path) -> None:
    try:
        with path.open("rb"):
            return
    except OSError as error:
        got = f"{path} ({error.strerror})"
        raise Misconfigured(argument, expected="a file that opens", got=got, hint="name one that is there") from None


def _require_table(argument: str, path: Path) -> None:
    """ViewMask at the header alone: the values are read, and judged, where the table is opened."""
    try:
        check_header(path, str(path), InvalidInput, expected=TABLE)
        handle: Any
        with safe_open(str(path), framework="np") as handle:
            shape = handle.get_slice("embeddings").get_shape()
            words = json.loads((handle.metadata() or {}).get("words", "null"))
    except InvalidInput as error:
        raise Misconfigured(argument, expected=error.expected, got=f"{error.got} at {path}") from None
    except (SafetensorError, OSError, ValueError, RecursionError) as error:
        raise Misconfigured(argument, expected=TABLE, got=f"{str(error)[:120]} in {path}") from None
    if len(shape) != 2 or not isinstance(words, list) or len(words) != shape[0]:
        count = f"{len(words)} words" if isinstance(words, list) else "no words"
        raise Misconfigured(argument, expected=TABLE, got=f"{path} with {count} and embeddings {shape}")
