"""The text towers of open_clip, with weights by name or from a local file."""

from __future__ import annotations

import logging
import warnings
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import torch

from liftcore.errors import InvalidQuery, Unavailable
from liftcore.query.encoders.torchvision_ops import import_torchvision

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from torch import Tensor

# open_clip reads these with weights_only; its loader of big_vision .npz files has no such switch.
_WEIGHT_SUFFIXES = (".safetensors", ".pt", ".pth", ".bin", ".ckpt")


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
        model_name, at, file = spec.partition("@")
        model_name, _, tag = (model_name, "", "") if at else spec.partition("/")
        label = f"encoder open_clip:{spec}"
        _check_model(label, model_name)
        if at:
            return cls(f"open_clip:{model_name}", *_from_file(label, model_name, Path(file)))
        return cls(f"open_clip:{model_name}/{tag}", *_from_tag(label, model_name, tag))

    @classmethod
    def _with_random_weights(cls, model_name: str) -> Self:
        """A model of the right shape that knows nothing: tests of plumbing only."""
        return cls(f"open_clip:{model_name} (random)", *_create(model_name, None))

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


def _check_model(label: str, model_name: str) -> None:
    known = _library().list_models()
    if model_name not in known:
        from rapidfuzz import process

        near = [match[0] for match in process.extract(model_name, known, limit=3)]
        raise InvalidQuery(
            label,
            expected="a model that open_clip knows",
            got=repr(model_name),
            hint=f"nearest: {', '.join(near)}",
        )


def _from_tag(label: str, model_name: str, tag: str) -> tuple[Any, Any]:
    tags = _library().list_pretrained_tags_by_model(model_name)
    if not tag:
        known = ", ".join(tags) or "none"
        raise Unavailable(
            label,
            expected="weights: a tag or a file",
            got="none",
            hint=f"open_clip:{model_name}/TAG or open_clip:{model_name}@FILE; tags: {known}",
        )
    if tag not in tags:
        raise InvalidQuery(label, expected=f"one of the tags {', '.join(tags) or '(none)'}", got=repr(tag))
    try:
        return _create(model_name, tag)
    except Exception as error:  # the hub's clients raise their own, urllib's and OSError's kinds
        raise Unavailable(
            label,
            expected="weights in the cache or a network to fetch them",
            got=str(error)[:200],
            hint=f"download them elsewhere and use open_clip:{model_name}@FILE",
        ) from None


def _from_file(label: str, model_name: str, path: Path) -> tuple[Any, Any]:
    if not path.is_file():
        raise Unavailable(label, expected="a file of weights", got=f"nothing at {path}")
    if path.suffix not in _WEIGHT_SUFFIXES:
        raise InvalidQuery(label, expected=f"a file ending in {', '.join(_WEIGHT_SUFFIXES)}", got=path.name)
    try:
        return _create(model_name, str(path))
    except Exception as error:  # unpickling and state dicts fail in many kinds; all mean "not these weights"
        raise InvalidQuery(
            label, expected=f"tensors of {model_name} and nothing else in {path.name}", got=str(error)[:200]
        ) from None


def _create(model_name: str, pretrained: str | None) -> tuple[Any, Any]:
    library = _library()
    with _quiet():
        model = library.create_model(
            model_name,
            pretrained=pretrained,
            require_pretrained=pretrained is not None,
            pretrained_text=False,
            weights_only=True,
        )
        tokenizer = library.get_tokenizer(model_name)
    # The image tower is most of the memory, and texts never pass through it.
    if hasattr(model, "visual"):
        model.visual = None
    return model, tokenizer


def _library() -> Any:
    try:
        import_torchvision()
        import open_clip
    except ImportError as error:
        raise Unavailable(
            "encoder open_clip", expected="the package open_clip_torch", got=str(error), hint="pip install it"
        ) from None
    return open_clip


@contextmanager
def _quiet() -> Iterator[None]:
    """open_clip logs to the root logger and warns of activations: what matters is raised as an error."""
    before = logging.root.manager.disable
    logging.disable(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
