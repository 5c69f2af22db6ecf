"""Public: text encoders behind one protocol, words in, unit vectors out. Importing this loads no torch."""

import logging
from collections import OrderedDict
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from liftcore.errors import InvalidInput, InvalidQuery, Unavailable
from liftcore.runtime.plugins import find_plugin, plugin_names

__all__ = ["BUILT_IN", "NO_WORDS", "OWN_WORDS", "TextEncoder", "check_encoder", "encoder_file", "open_encoder"]
ENCODER_SPECS = (
    "table:FILE.safetensors",
    "lvis",
    "minilm",
    "open_clip:MODEL/PRETRAINED_TAG",
    "open_clip:MODEL@WEIGHTS_FILE",
    "open_clip:...#7 or #80, templates",
)
# Encoders that need no file of the user's, and the text space of each: what answers when nobody chose an encoder.
BUILT_IN = {"lvis": "open_clip:ViT-B-32/openai", "minilm": "minilm"}
LVIS_TABLE = Path(__file__).with_name("lvis_clip_vit_b_32.safetensors")  # its licences: service/commands/tabletop
PLUGINS = "splatlift.text_encoders"  # the entry points of other packages' encoders
TEMPLATES = (1, 7, 80)  # sentences that open_clip's encoders put a word into: the word alone, or CLIP's for ImageNet
NO_WORDS = "none"  # the text space of features that no text encoder shares
OWN_WORDS = "prompts"  # of features whose packs bring their words
REMEMBERED = 1_024  # texts; two megabytes at 512 channels
log = logging.getLogger(__name__)


class TextEncoder(Protocol):
    """Maps texts into the space of the lifted features."""

    @property
    def name(self) -> str:
        """What the encoder is, for messages and metadata."""
        ...

    @property
    def channels(self) -> int:
        """F, the length of its vectors."""
        ...

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        """n texts -> [n, F] f32 with unit rows.

        Raises:
            InvalidQuery: a text that the encoder cannot read (a word that a table lacks, an empty text), or no list
                of texts.
        """
        ...


def without_templates(spec: str) -> tuple[str, int]:
    """A specification without its ``#7`` or ``#80``, and how many templates it asks for."""
    bare, mark, count = spec.rpartition("#")
    known = mark and spec.startswith("open_clip:") and count in map(str, TEMPLATES)
    return (bare, int(count)) if known else (spec, 1)


def encoder_file(spec: str) -> Path | None:
    """The file that an encoder specification names, None when it names none."""
    if spec.startswith("table:"):
        return Path(spec.removeprefix("table:"))
    if spec.startswith("open_clip:") and "@" in spec:
        return Path(without_templates(spec)[0].partition("@")[2])
    return Path(spec) if spec.endswith(".safetensors") else None


def check_encoder(spec: str) -> None:
    """See that a specification is one of an encoder, that its file opens, and that a table looks like one.

    Values are read, and judged, where the encoder is opened.

    Raises:
        InvalidInput: there is no such encoder, its file is missing or does not open, or a table is none.
    """
    file = encoder_file(spec)
    if file is None:
        if spec not in BUILT_IN and not spec.startswith("open_clip:"):
            raise InvalidInput("encoder", expected=f"one of {', '.join(ENCODER_SPECS)}", got=repr(spec))
        return
    try:
        file.open("rb").close()
    except OSError as error:
        got, hint = f"{file} ({error.strerror})", "name one that is there"
        raise InvalidInput("encoder", expected="a file that opens", got=got, hint=hint) from None
    if not spec.startswith("open_clip:"):
        from liftcore.text.table import check_table

        check_table(file)


def open_encoder(spec: str | Path, *, remembers: bool = False) -> TextEncoder:
    """Open a text encoder by its specification: ``open_encoder("lvis").encode(["mug"])`` is what lifts are asked by.

    Args:
        spec: ``table:FILE`` or a path ending in ``.safetensors`` (precomputed embeddings); ``lvis`` (a table of the
            1,203 words of LVIS by CLIP ViT-B/32, shipped); ``minilm`` (a small sentence encoder, offline);
            ``open_clip:MODEL/TAG`` or ``open_clip:MODEL@FILE``, with ``#7`` or ``#80`` behind for the mean over as
            many of CLIP's sentences for ImageNet ("a photo of the small mug."); or ``NAME`` or ``NAME:REST`` of a
            plugin (`liftcore.runtime.plugins`), which is called with the rest.
        remembers: whether the vectors of the last texts are kept.

    Raises:
        InvalidQuery: the specification is none of these, or a table is malformed.
        Unavailable: the encoder's weights are not on this machine, or a plugin fails.
    """
    if remembers:
        return RememberingEncoder(open_encoder(spec))
    spec, templates = without_templates(str(spec))
    kind, _, rest = spec.partition(":")
    # A bare path may hold a colon itself, so the suffix is asked first.
    if kind != "table" and spec.endswith(".safetensors") and not spec.startswith("open_clip:"):
        kind, rest = "table", spec
    if spec == "lvis" or (kind == "table" and rest):
        from liftcore.text.table import TableEncoder

        return TableEncoder.open(Path(rest) if rest else LVIS_TABLE)
    if spec == "minilm":
        from liftcore.text.minilm import MiniLmEncoder

        return MiniLmEncoder()
    if kind == "open_clip" and rest and ("@" in rest or "#" not in rest):
        from liftcore.text.open_clip import OpenClipEncoder

        return OpenClipEncoder.open(rest, templates)
    if plugin := find_plugin(PLUGINS, kind, ("table", "open_clip", *BUILT_IN)):
        return plugin.call(rest, needs=("name", "channels", "encode"))
    specs = [*ENCODER_SPECS, *(f"{name}:..." for name in plugin_names(PLUGINS) if name not in BUILT_IN)]
    raise InvalidQuery("encoder", expected=f"one of {', '.join(specs)}", got=repr(spec))


def encoder_of_space(text_space: str, hint: str = "", *, stand_in: bool = False) -> TextEncoder:
    """The encoder of a lift's text space.

    Args:
        hint: what else can be done.
        stand_in: where its weights cannot be had, take the table of it that ships, which knows its own words alone.

    Raises:
        InvalidQuery: the space has no name, or no words, or is no encoder's.
        Unavailable: the encoder's weights are not on this machine, and no table stands in.
    """
    if text_space in ("", NO_WORDS):
        space = f"is {NO_WORDS!r}: its features share no space with words" if text_space else "is not named"
        got = f"none, and the lift's text space {space}"
        raise InvalidQuery("encoder", expected="a text encoder, or a table of words", got=got, hint=hint)
    try:
        return open_encoder(text_space)
    except InvalidQuery as error:
        got = f"none, and the lift's text space {text_space!r} is not one that opens by its name ({error})"
        raise InvalidQuery("encoder", expected="a text encoder, or a table of words", got=got, hint=hint) from None
    except Unavailable:
        ships = next((name for name, space in BUILT_IN.items() if space == text_space != name), None)
        if ships is None or not stand_in:
            raise
        log.warning("%s: its weights are not here; the table %s answers, with its own words alone", text_space, ships)
        return open_encoder(ships)


def check_texts(texts: Sequence[str], argument: str = "texts") -> None:
    """Refuse what is no list of texts, and texts that say nothing.

    Raises:
        InvalidQuery: a text alone, something else than texts, or an empty one.
    """
    listed = isinstance(texts, Collection) and not isinstance(texts, str)
    if not listed or not all(isinstance(text, str) for text in texts):
        raise InvalidQuery(argument, expected="a list of texts", got=repr(texts)[:80], hint='such as ["a mug"]')
    if not all(text.strip() for text in texts):
        raise InvalidQuery("text", expected="a word or a sentence", got="an empty text")


class RememberingEncoder:
    """Another encoder, asked only for texts that are not among the last ones (``TextEncoder``).

    People ask for a mask after they asked for the words.
    """

    def __init__(self, encoder: TextEncoder, size: int = REMEMBERED) -> None:
        self.source = encoder
        self._size = size
        self._rows: OrderedDict[str, np.ndarray] = OrderedDict()

    @property
    def name(self) -> str:
        """The other encoder's."""
        return self.source.name

    @property
    def channels(self) -> int:
        """The other encoder's."""
        return self.source.channels

    @property
    def words(self) -> Sequence[str]:
        """Those that the other encoder is limited to; none where it reads any text."""
        return getattr(self.source, "words", ())

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        """n texts -> [n, F] f32 unit rows; errors are the other encoder's, and are not remembered."""
        new = [text for text in dict.fromkeys(texts) if text not in self._rows]
        rows = dict(zip(new, self.source.encode(new), strict=True)) if new else {}
        for text in texts:
            if text in self._rows:
                rows[text] = self._rows[text]
                self._rows.move_to_end(text)
        self._rows.update((text, rows[text]) for text in new)
        while len(self._rows) > self._size:
            self._rows.popitem(last=False)
        return np.stack([rows[text] for text in texts]) if texts else np.empty((0, self.channels), np.float32)
