"""Models of open_clip, with weights by name or from a local file, and their text towers as encoders.

The image towers are used by `liftcore.features.encoders.clip`.
"""

import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch

from liftcore.errors import InvalidQuery, Unavailable
from liftcore.runtime.nearest import nearest
from liftcore.text import BUILT_IN, check_texts
from liftcore.text.torchvision_ops import import_torchvision
from liftcore.text.weights import fetch_weights

# open_clip and timm read these with weights_only; the loader of big_vision .npz files has no such switch.
WEIGHT_SUFFIXES = (".safetensors", ".pt", ".pth", ".bin", ".ckpt")


@dataclass(frozen=True)
class OpenedModel:
    """A model with its weights."""

    name: str  # ``open_clip:MODEL/TAG``, or ``open_clip:MODEL`` for weights of a file
    model_name: str  # open_clip's name of the architecture
    model: Any  # open_clip's module, both towers


def open_model(kind: str, spec: str) -> OpenedModel:
    """Load ``MODEL/PRETRAINED_TAG`` (cached or downloaded by open_clip) or ``MODEL@WEIGHTS_FILE``.

    Local files are read with ``weights_only``: a pickle that contains more than tensors is an error.

    Args:
        kind: the user's text before the colon, for messages.
        spec: the text after the colon.
    """
    model_name, at, file = spec.partition("@")
    model_name, _, tag = (model_name, "", "") if at else spec.partition("/")
    label = f"encoder {kind}:{spec}"
    _check_model(label, model_name)
    if at:
        return OpenedModel(f"open_clip:{model_name}", model_name, _from_file(label, model_name, Path(file)))
    return OpenedModel(f"open_clip:{model_name}/{tag}", model_name, _from_tag(kind, model_name, tag))


def create_model(model_name: str, pretrained: str | None) -> Any:
    """Create a model with the weights of a tag or a file; None = random weights, for tests only."""
    with _quiet():
        return library().create_model(
            model_name,
            pretrained=pretrained,
            require_pretrained=pretrained is not None,
            pretrained_text=False,
            weights_only=True,
        )


def tokenizer_of(model_name: str) -> Callable[[list[str]], Any]:
    """Return the model's tokenizer."""
    with _quiet():
        try:
            return library().get_tokenizer(model_name)
        except ImportError as error:
            expected = "the package transformers, which has the tokenizer of this model"
            raise Unavailable(
                f"encoder open_clip:{model_name}", expected=expected, got=str(error), hint="pip install transformers"
            ) from None


def library() -> Any:
    """Import and return the module open_clip."""
    try:
        import_torchvision()
        import open_clip
    except ImportError as error:
        hint = "pip install 'splatlift[encoders]'"
        expected = "the package open_clip_torch"
        raise Unavailable("encoder open_clip", expected=expected, got=str(error), hint=hint) from None
    return open_clip


def _check_model(label: str, model_name: str) -> None:
    model_names = library().list_models()
    if model_name not in model_names:
        raise InvalidQuery(
            label,
            expected="a model of open_clip",
            got=repr(model_name),
            hint=nearest(model_name, model_names, 3),
        )


def _from_tag(kind: str, model_name: str, tag: str) -> Any:
    label = f"encoder {kind}:{model_name}/{tag}" if tag else f"encoder {kind}:{model_name}"
    tags = library().list_pretrained_tags_by_model(model_name)
    if not tag:
        tag_names = ", ".join(tags) or "none"
        raise Unavailable(
            label,
            expected="weights: a tag or a file",
            got="none",
            hint=f"{kind}:{model_name}/TAG or {kind}:{model_name}@FILE; tags: {tag_names}",
        )
    if tag not in tags:
        raise InvalidQuery(label, expected=f"one of the tags {', '.join(tags) or '(none)'}", got=repr(tag))
    words = "; the encoder lvis has 1,203 words of this model" if label == f"encoder {BUILT_IN['lvis']}" else ""
    hint = f"download the weights on another machine and use {kind}:{model_name}@FILE{words}"
    return fetch_weights(label, lambda: create_model(model_name, tag), hint)


def _from_file(label: str, model_name: str, path: Path) -> Any:
    if not path.is_file():
        raise Unavailable(label, expected="a file of weights", got=f"nothing at {path}")
    if path.suffix not in WEIGHT_SUFFIXES:
        raise InvalidQuery(label, expected=f"a file ending in {', '.join(WEIGHT_SUFFIXES)}", got=path.name)
    try:
        return create_model(model_name, str(path))
    except Exception as error:  # readers of pickles and state dicts raise many types for files of other content
        raise InvalidQuery(
            label, expected=f"only tensors of {model_name} in {path.name}", got=str(error)[:200]
        ) from None


@contextmanager
def _quiet() -> Iterator[None]:
    """Disable open_clip's logs, which go to the root logger, and its warnings; failures raise errors anyway."""
    before = logging.root.manager.disable
    logging.disable(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


class OpenClipEncoder:
    """Encoder of texts into the space that a CLIP model shares with its images.

    Create it with `open`. Random weights are used in tests only.
    """

    def __init__(self, name: str, model: Any, tokenizer: Callable[[list[str]], Any], templates: int = 1) -> None:
        self.name = name if templates == 1 else f"{name}#{templates}"
        self._templates = _templates(templates)
        self._model = model.eval()
        self._tokenizer = tokenizer
        self.channels = int(self._encode(["a"]).shape[1])

    @classmethod
    def open(cls, spec: str, templates: int = 1) -> Self:
        """Load ``MODEL/PRETRAINED_TAG`` (cached or downloaded by open_clip) or ``MODEL@WEIGHTS_FILE``.

        Local files are read with ``weights_only``: a pickle that contains more than tensors is an error.
        """
        model = open_model("open_clip", spec)
        return cls(model.name, _without_images(model.model), tokenizer_of(model.model_name), templates)

    @classmethod
    def _with_random_weights(cls, model_name: str, templates: int = 1) -> Self:
        """Create an encoder with random weights of the right shapes, for tests only."""
        model = _without_images(create_model(model_name, None))
        return cls(f"open_clip:{model_name} (random)", model, tokenizer_of(model_name), templates)

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        """Encode n texts as [n, F] f32 unit rows."""
        check_texts(texts)
        if not texts:
            return np.empty((0, self.channels), np.float32)
        if not self._templates:
            return self._encode(list(texts))
        means = [self._encode([template(text) for template in self._templates]).mean(axis=0) for text in texts]
        return np.stack([mean / np.linalg.norm(mean) for mean in means])

    def _encode(self, texts: list[str]) -> np.ndarray:
        with torch.no_grad():
            rows = self._model.encode_text(self._tokenizer(texts)).to(torch.float32)
            return (rows / torch.linalg.vector_norm(rows, dim=1, keepdim=True)).numpy()


def _templates(count: int) -> Sequence[Callable[[str], str]]:
    """Return CLIP's sentences for ImageNet: all 80, or the 7 of its prompt notebook; none for any other count."""
    library()
    from open_clip import zero_shot_metadata

    templates = {7: zero_shot_metadata.SIMPLE_IMAGENET_TEMPLATES, 80: zero_shot_metadata.OPENAI_IMAGENET_TEMPLATES}
    return templates.get(count, ())


def _without_images(model: Any) -> Any:
    # The image tower takes most of the memory and is not used for texts.
    if hasattr(model, "visual"):
        model.visual = None
    return model
