"""Which text encoder answers for a text space, and the files that encoders are read from.

The process that queries opens an encoder at the first question to it, and an error is then told to whoever asked,
who can do nothing about it: so `require_encoder_files` looks before the service starts.
"""

from __future__ import annotations

import json

from liftcore.errors import InvalidInput
from liftcore.text import BUILT_IN, NO_WORDS, OWN_WORDS, check_encoder, encoder_file
from service.errors import InvalidRequest, Misconfigured
from service.settings import ServiceSettings


def encoder_spec(settings: ServiceSettings, text_space: str, asked: str | None) -> str:
    """The text encoder of a query: the one of the space asked for, else of the lift's.

    The default stands in for a space that has none only where the operator chose it: scores of an encoder of
    another space look like any others, and mean nothing. Encoders that need no file answer for their own spaces,
    and a lift that brings its words is asked in these: ``OWN_WORDS``. A lift's own space may
    be asked for by its name.

    Raises:
        InvalidRequest: no encoder was set up under the name asked for, or for the lift's text space.
    """
    if asked == "default":
        return settings.encoder
    if asked in (None, text_space) and text_space == OWN_WORDS:
        return OWN_WORDS
    if asked not in (None, text_space):
        if asked not in settings.text_spaces:
            known = ", ".join(["default", *sorted(settings.text_spaces)])
            raise InvalidRequest(
                "encoder", expected="the name of a text space that the operator set up", got=repr(asked),
                hint=f"known here: {known}",
            )  # fmt: skip
        return settings.text_spaces[asked]
    if text_space in settings.text_spaces:
        return settings.text_spaces[text_space]
    if text_space == settings.encoder or (text_space != NO_WORDS and "encoder" in settings.model_fields_set):
        return settings.encoder
    for encoder, space in BUILT_IN.items():
        if text_space == space:
            return encoder
    raise _no_encoder(settings, text_space)


def _no_encoder(settings: ServiceSettings, text_space: str) -> InvalidRequest:
    if text_space == NO_WORDS:
        return InvalidRequest(
            "lift", expected="features that share a space with a text encoder", got="text space 'none'",
            hint="ask by example, with like=; or name an encoder with encoder= if you know better",
        )  # fmt: skip
    example = json.dumps({text_space or "NAME": "table:FILE"})
    return InvalidRequest(
        "lift", expected="features of a text space that this server has an encoder for",
        got=f"text space {text_space!r}" if text_space else "features that name no text space",
        hint="ask with table=ID of an uploaded text table, or by example, with like="
        + ("" if text_space else "; PATCH /assets/{asset} names a pack's text space, for a lift of it")
        + f"; or the operator sets SPLATLIFT_TEXT_SPACES='{example}' or SPLATLIFT_ENCODER;"
        f" encoder=default asks {encoder_label(settings.encoder)} all the same",
    )  # fmt: skip


def encoder_label(spec: str) -> str:
    """An encoder as clients may know it: its specification without a file of the server."""
    return "table" if spec.startswith("table:") or spec.endswith(".safetensors") else spec.partition("@")[0]


def encoder_version(spec: str) -> list[int] | None:
    """What changes when the file of an encoder does: its time and size; None without a file."""
    file = encoder_file(spec)
    try:
        status = file.stat() if file is not None else None
    except OSError:
        return None
    return None if status is None else [status.st_mtime_ns, status.st_size]


def require_encoder_files(settings: ServiceSettings) -> None:
    """See that every file that a text encoder of the settings names is there, and that tables look like ones.

    Raises:
        Misconfigured: there is no such encoder, a file is missing or does not open, or a table is none. The setting
            is named.
    """
    named = {"encoder": settings.encoder}
    named |= {f"text_spaces, {space!r}": spec for space, spec in settings.text_spaces.items()}
    for argument, spec in named.items():
        try:
            check_encoder(spec)
        except InvalidInput as error:
            got, hint = error.got, error.hint
            raise Misconfigured(argument, expected=error.expected, got=got, hint=hint) from None
