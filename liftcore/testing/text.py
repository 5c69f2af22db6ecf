"""A conformance suite of text encoders for pytest."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidQuery

if TYPE_CHECKING:
    from liftcore.text import TextEncoder

CLOSE = 1e-5  # on a vector's entries, for any other texts in the batch


class TextEncoderConformance(ABC):
    """Tests of a `TextEncoder` for pytest: derive a class ``Test...`` and open your encoder."""

    texts: tuple[str, ...] = ("mug", "chair", "banana")  # different texts that the encoder supports

    @abstractmethod
    def open_encoder(self) -> TextEncoder:
        """Open the encoder."""

    def test_name_and_channels_say_what_it_is(self) -> None:
        encoder = self.open_encoder()
        assert isinstance(encoder.name, str) and encoder.name
        assert isinstance(encoder.channels, int) and encoder.channels > 0

    def test_vectors_are_unit_rows_of_float32_in_the_order_of_the_texts(self) -> None:
        encoder = self.open_encoder()
        rows = encoder.encode(list(self.texts))
        assert rows.shape == (len(self.texts), encoder.channels) and rows.dtype == np.float32
        np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1.0, atol=1e-4)
        single_rows = np.concatenate([encoder.encode([text]) for text in self.texts])
        np.testing.assert_allclose(rows, single_rows, atol=CLOSE)
        np.testing.assert_allclose(encoder.encode(list(reversed(self.texts))), rows[::-1], atol=CLOSE)
        assert len(np.unique(rows.round(4), axis=0)) == len(self.texts)

    def test_same_text_has_the_same_bits(self) -> None:
        first, second = (self.open_encoder().encode(list(self.texts)) for _ in range(2))
        assert np.array_equal(first, second)

    def test_no_texts_are_no_rows(self) -> None:
        encoder = self.open_encoder()
        assert encoder.encode([]).shape == (0, encoder.channels)

    def test_what_is_no_list_of_texts_is_refused(self) -> None:
        wrong: list[Any] = ["mug", [7], [""], None]
        for texts in wrong:
            try:
                self.open_encoder().encode(texts)
            except InvalidQuery:
                continue
            raise AssertionError(f"encode({texts!r}) must raise InvalidQuery: liftcore.text.check_texts does")
