# pyright: strict
"""A custom text encoder, tested by splatlift's conformance suite: ``pytest examples/test_my_encoder.py``."""

import hashlib
from collections.abc import Sequence

import numpy as np

import liftcore as lc
from liftcore.testing import TextEncoderConformance
from liftcore.text import check_texts


class HashedLetters:
    """Words as sums of random directions, one for each group of three letters; shared groups make words similar."""

    name = "hashed letters"
    channels = 64

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        """n texts -> [n, 64] f32, unit rows."""
        check_texts(texts)
        rows = np.zeros((len(texts), self.channels), np.float32)
        for number, text in enumerate(texts):
            word = f"  {text.lower()} "
            for group in (word[k : k + 3] for k in range(len(word) - 2)):
                seed = int.from_bytes(hashlib.sha256(group.encode()).digest()[:8], "little")
                rows[number] += np.random.default_rng(seed).normal(size=self.channels)
        return rows / np.linalg.norm(rows, axis=1, keepdims=True)


class TestHashedLetters(TextEncoderConformance):
    """All tests of the suite."""

    def open_encoder(self) -> lc.TextEncoder:
        return HashedLetters()
