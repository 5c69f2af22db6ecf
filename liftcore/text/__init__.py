"""Public: text encoders behind one protocol, from words to unit vectors. Importing this loads no torch."""

import logging
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from liftcore.errors import InvalidInput, InvalidQuery, Unavailable, reading

__all__ = [
    "BUILT_IN", "NO_WORDS", "OWN_WORDS", "CachingEncoder", "TextEncoder", "check_encoder", "encoder_file",
    "open_encoder",
]  # fmt: skip
ENCODER_SPECS = (
    "table:FILE.safetensors",
    "lvis",
    "open_clip:MODEL/PRETRAINED_TAG",
    "open_clip:MODEL@WEIGHTS_FILE",
    "open_clip:...#7 or #80, templates",
)
# Encoders that need no file from the user, and the text space of each: the defaults where no encoder was chosen.
BUILT_IN = {"lvis": "open_clip:ViT-B-32/openai"}
LVIS_TABLE = Path(__file__).with_name("lvis_clip_vit_b_32.safetensors")  # its licences: service/commands/tabletop
TABLES = (".safetensors", ".npy", ".npz", ".pt")  # of these only the first is read: the others' error says how
TEMPLATES = (1, 7, 80)  # numbers of sentences that a word is put into: 1 is the word alone, 7 and 80 are CLIP's
NO_WORDS = "none"  # the text space of features that no text encoder shares
OWN_WORDS = "prompts"  # the text space of features whose packs contain their words
CACHE_SIZE = 1_024  # texts, of which all are forgotten beyond; two megabytes at 512 channels
log = logging.getLogger(__name__)


class TextEncoder(Protocol):
    """A map from texts into the space of the lifted features."""

    @property
    def name(self) -> str:
        """Name of the encoder, for messages and metadata."""
        ...

    @property
    def channels(self) -> int:
        """Length F of its vectors."""
        ...

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        """Encode n texts as [n, F] f32 with unit rows.

        Raises:
            InvalidQuery: a text that the encoder cannot read (a word that is not in a table, an empty text), or
                ``texts`` is not a list of texts.
        """
        ...


def without_templates(spec: str) -> tuple[str, int]:
    """Split a specification into the part before ``#7`` or ``#80`` and the number of templates."""
    bare, mark, count = spec.rpartition("#")
    has_templates = mark and spec.startswith("open_clip:") and count in map(str, TEMPLATES)
    return (bare, int(count)) if has_templates else (spec, 1)


def encoder_file(spec: str) -> Path | None:
    """Return the file of an encoder specification, None if it has no file."""
    if spec.startswith("table:"):
        return Path(spec.removeprefix("table:"))
    if spec.startswith("open_clip:") and "@" in spec:
        return Path(without_templates(spec)[0].partition("@")[2])
    return Path(spec) if spec.endswith(TABLES) else None


def check_encoder(spec: str) -> None:
    """Check that a specification is valid, that its file opens, and that a table is one."""
    if (file := encoder_file(spec)) is not None:
        with reading(f"encoder {file}", InvalidInput, "a readable file", "check the path and its permissions"):
            file.open("rb").close()
    if not spec.startswith("open_clip:"):
        open_encoder(spec)


def open_encoder(spec: str | Path) -> TextEncoder:
    """Open a text encoder by its specification, such as ``open_encoder("lvis").encode(["mug"])``.

    Args:
        spec: ``table:FILE`` or a path ending in ``.safetensors`` (precomputed embeddings); ``lvis`` (a table of the
            1,203 words of LVIS by CLIP ViT-B/32, shipped); ``open_clip:MODEL/TAG`` or ``open_clip:MODEL@FILE``, with
            the suffix ``#7`` or ``#80`` for the mean over that many of CLIP's sentences for ImageNet ("a photo of
            the small mug.").

    Raises:
        InvalidQuery: the specification is not one of these, or a table is malformed.
        Unavailable: the encoder's weights are not on this machine.
    """
    spec, templates = without_templates(str(spec))
    kind, _, rest = spec.partition(":")
    # A path may contain a colon, so the suffix is compared first.
    if kind != "table" and spec.endswith(TABLES) and not spec.startswith("open_clip:"):
        kind, rest = "table", spec
    if spec == "lvis" or (kind == "table" and rest):
        from liftcore.text.table import TableEncoder

        return TableEncoder.open(Path(rest) if rest else LVIS_TABLE)
    if kind == "open_clip" and rest and ("@" in rest or "#" not in rest):
        from liftcore.text.open_clip import OpenClipEncoder

        return OpenClipEncoder.open(rest, templates)
    raise InvalidQuery("encoder", expected=f"one of {', '.join(ENCODER_SPECS)}", got=repr(spec))


def encoder_of_space(text_space: str, hint: str, *, stand_in: bool) -> TextEncoder:
    """Open the encoder of a lift's text space; ``hint`` is the advice of an error.

    A ``stand_in`` for weights that are not available is the shipped table of this encoder, which has its own words.
    """
    if text_space in ("", NO_WORDS):
        space = f"is {NO_WORDS!r}: its features share no space with words" if text_space else "is not recorded"
        got = f"none, and the lift's text space {space}"
        raise InvalidQuery("encoder", expected="a text encoder, or a table of words", got=got, hint=hint)
    try:
        return open_encoder(text_space)
    except InvalidQuery as error:
        got = f"none, and the lift's text space {text_space!r} is not the name of an available encoder ({error})"
        raise InvalidQuery("encoder", expected="a text encoder, or a table of words", got=got, hint=hint) from None
    except Unavailable:
        ships = next((name for name, space in BUILT_IN.items() if space == text_space != name), None)
        if ships is None or not stand_in:
            raise
        log.warning("%s: weights not available; using the table %s, which has only its own words", text_space, ships)
        return open_encoder(ships)


def check_texts(texts: Sequence[str], argument: str = "texts") -> None:
    """Check that ``texts`` is a list of non-empty texts."""
    is_list = isinstance(texts, Collection) and not isinstance(texts, str)
    if not is_list or not all(isinstance(text, str) for text in texts):
        raise InvalidQuery(argument, expected="a list of texts", got=repr(texts)[:80], hint='such as ["a mug"]')
    if not all(text.strip() for text in texts):
        raise InvalidQuery("text", expected="a word or a sentence", got="an empty text")


class CachingEncoder:
    """A `TextEncoder` that caches the vectors of the last texts of another encoder.

    The same words are often queried several times in a row, first for scores, then for a mask.
    """

    def __init__(self, encoder: TextEncoder, size: int = CACHE_SIZE) -> None:
        self.source, self.name, self.channels = encoder, encoder.name, encoder.channels
        self.words: Sequence[str] = getattr(encoder, "words", ())  # that it is limited to; empty: it encodes any text
        self._size, self._rows = size, dict[str, np.ndarray]()

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        """Encode n texts as [n, F] f32 unit rows. Errors of the other encoder are raised and not cached."""
        check_texts(texts)
        if len(self._rows.keys() | set(texts)) > self._size:
            self._rows.clear()
        if new := [text for text in dict.fromkeys(texts) if text not in self._rows]:
            self._rows.update(zip(new, self.source.encode(new), strict=True))
        return np.stack([self._rows[text] for text in texts]) if texts else np.empty((0, self.channels), np.float32)
