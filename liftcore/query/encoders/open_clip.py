"""The text towers of open_clip, with weights by name or from a local file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self

import torch

from liftcore.errors import InvalidQuery
from liftcore.query.encoders.open_clip_models import create_model, open_model, tokenizer_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from torch import Tensor


class OpenClipEncoder:
    """Texts to the space that a CLIP model shares with its images.

    Build it with `open`: a model never runs with random weights unless a test asks for them.
    """

    def __init__(self, name: str, model: Any, tokenizer: Callable[[list[str]], Tensor]) -> None:
        self.name = name
        self._model = model.eval()
        self._tokenizer = tokenizer
        self.channels = int(self._encode(["a"]).shape[1])

    @classmethod
    def open(cls, spec: str) -> Self:
        """Load ``MODEL/PRETRAINED_TAG`` (cached or downloaded by open_clip) or ``MODEL@WEIGHTS_FILE``.

        Local files are read with ``weights_only``: a pickle that holds more than tensors is refused.

        Raises:
            InvalidQuery: an unknown model or tag, or a file that is not weights of this model.
            Unavailable: no weights were named, or they cannot be had here.
        """
        opened = open_model("open_clip", spec)
        return cls(opened.name, _without_images(opened.model), tokenizer_of(opened.model_name))

    @classmethod
    def _with_random_weights(cls, model_name: str) -> Self:
        """A model of the right shape that knows nothing: tests of plumbing only."""
        model = _without_images(create_model(model_name, None))
        return cls(f"open_clip:{model_name} (random)", model, tokenizer_of(model_name))

    def encode(self, texts: Sequence[str]) -> Tensor:
        """n texts -> [n, F] f32 unit rows.

        Raises:
            InvalidQuery: an empty text.
        """
        for text in texts:
            if not text.strip():
                raise InvalidQuery("text", expected="a word or a sentence", got="an empty text")
        return self._encode(list(texts)) if texts else torch.empty(0, self.channels)

    def _encode(self, texts: list[str]) -> Tensor:
        with torch.no_grad():
            rows = self._model.encode_text(self._tokenizer(texts)).to(torch.float32)
        return rows / torch.linalg.vector_norm(rows, dim=1, keepdim=True)


def _without_images(model: Any) -> Any:
    # The image tower is most of the memory, and texts never pass through it.
    if hasattr(model, "visual"):
        model.visual = None
    return model
