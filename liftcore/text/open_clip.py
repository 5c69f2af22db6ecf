"""Models of open_clip, with weights by name or from a local file, and their text towers as encoders.

The image towers are used by `liftcore.features.encoders.clip`.
"""

import importlib
import logging
import threading
import urllib.error
import urllib.request
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeVar
from urllib.parse import urlsplit

import numpy as np
import torch

from liftcore.errors import InvalidQuery, Unavailable
from liftcore.runtime.arguments import nearest
from liftcore.text import BUILT_IN, check_texts

T = TypeVar("T")
SECONDS = 5.0  # timeout of the first response
EXPECTED = "weights in the cache or a network to fetch them"
log = logging.getLogger(__name__)
# open_clip and timm read these with weights_only; the loader of big_vision .npz files has no such switch.
WEIGHT_SUFFIXES = (".safetensors", ".pt", ".pth", ".bin", ".ckpt")


@dataclass(frozen=True)
class OpenedModel:
    """A model with its weights."""

    name: str  # ``open_clip:MODEL/TAG``, or ``open_clip:MODEL`` for weights of a file
    text_space: str  # the name, with the path of a file of weights, as queries open it
    model_name: str  # open_clip's name of the architecture
    model: Any  # open_clip's module, both towers


def open_model(kind: str, spec: str) -> OpenedModel:
    """Load ``MODEL/PRETRAINED_TAG`` (cached or downloaded by open_clip) or ``MODEL@WEIGHTS_FILE``.

    Local files are read with ``weights_only``: a pickle that contains more than tensors is an error.
    """
    model_name, at, file = spec.partition("@")
    model_name, _, tag = (model_name, "", "") if at else spec.partition("/")
    label, model_names = f"encoder {kind}:{spec}", library().list_models()
    if model_name not in model_names:
        hint = nearest(model_name, model_names, 3)
        raise InvalidQuery(label, expected="a model of open_clip", got=repr(model_name), hint=hint)
    if at:
        name, model = f"open_clip:{model_name}", _from_file(label, model_name, Path(file))
        return OpenedModel(name, f"{name}@{Path(file).resolve()}", model_name, model)
    name = f"open_clip:{model_name}/{tag}"
    return OpenedModel(name, name, model_name, _from_tag(label, kind, model_name, tag))


def create_model(model_name: str, pretrained: str) -> Any:
    """Create a model with the weights of a tag or a file."""
    options = {"require_pretrained": True, "pretrained_text": False, "weights_only": True}
    with _quiet():
        return library().create_model(model_name, pretrained=pretrained, **options)


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


def library(name: str = "open_clip") -> Any:
    """Import and return the module of encoders of this name."""
    try:
        import_torchvision()
        return importlib.import_module(name)
    except ImportError as error:
        expected, hint = f"the package {name}", "pip install 'splatlift[encoders]'"
        raise Unavailable(f"encoder {name}", expected=expected, got=str(error), hint=hint) from None


def _from_tag(label: str, kind: str, model_name: str, tag: str) -> Any:
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
    require_weights(label, path)
    try:
        return create_model(model_name, str(path))
    except Exception as error:  # readers of pickles and state dicts raise many types for files of other content
        raise InvalidQuery(
            label, expected=f"only tensors of {model_name} in {path.name}", got=str(error)[:200]
        ) from None


def require_weights(label: str, path: Path) -> None:
    """Refuse a path without a file, or with one that no loader reads without running code."""
    if not path.is_file():
        raise Unavailable(label, expected="a file of weights", got=f"nothing at {path}")
    if path.suffix not in WEIGHT_SUFFIXES:
        raise InvalidQuery(label, expected=f"a file ending in {', '.join(WEIGHT_SUFFIXES)}", got=path.name)


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
    """Encoder of texts into the space that a CLIP model shares with its images (`open`)."""

    def __init__(self, name: str, model: Any, tokenizer: Callable[[list[str]], Any], templates: int = 1) -> None:
        self.name = name if templates == 1 else f"{name}#{templates}"
        self._templates = _templates(templates)
        self._model = model.eval()
        self._tokenizer = tokenizer
        self.channels = int(self._encode(["a"]).shape[1])

    @classmethod
    def open(cls, spec: str, templates: int = 1) -> Self:
        """Load ``MODEL/PRETRAINED_TAG`` or ``MODEL@WEIGHTS_FILE`` (`open_model`)."""
        clip_model = open_model("open_clip", spec)
        if hasattr(clip_model.model, "visual"):  # the image tower takes most of the memory and is not used for texts
            clip_model.model.visual = None
        return cls(clip_model.name, clip_model.model, tokenizer_of(clip_model.model_name), templates)

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


# ---- weights by name, from the cache of their library or else from the network, in one attempt: the libraries
# themselves contact the network first and retry for most of a minute if there is none


def fetch_weights(label: str, load: Callable[[], T], hint: str) -> T:
    """Call ``load``, which reads weights of the Hugging Face Hub, and return its result. A download is logged."""
    from huggingface_hub import constants

    with _cache_alone(), suppress(Exception):  # each library raises its own types
        return load()
    host = urlsplit(constants.ENDPOINT).netloc
    if constants.HF_HUB_OFFLINE:
        raise Unavailable(label, expected=EXPECTED, got="none, and HF_HUB_OFFLINE is set", hint=hint)
    if not _is_reachable(constants.ENDPOINT):
        got = f"neither: {host} did not respond within {SECONDS:g} s"
        raise Unavailable(label, expected=EXPECTED, got=got, hint=hint)
    log.warning("%s: downloading weights from %s", label, host)
    try:
        return load()
    except Exception as error:  # clients of the hub raise their own types, those of urllib and OSErrors
        got = " ".join(str(error).split())
        raise Unavailable(label, expected=EXPECTED, got=got[:200], hint=hint) from None


@contextmanager
def _cache_alone() -> Iterator[None]:
    """Make the hub's client refuse every request at once, so that only its cache is read."""
    from huggingface_hub import constants

    before = constants.HF_HUB_OFFLINE
    constants.HF_HUB_OFFLINE = True
    try:
        yield
    finally:
        constants.HF_HUB_OFFLINE = before


def _is_reachable(url: str) -> bool:
    """Return True if the host responds in time. A thread waits for it, as name resolution has no timeout."""
    answers: list[bool] = []

    def request_head() -> None:
        with suppress(OSError, ValueError):
            with suppress(urllib.error.HTTPError):  # an error status is a response too
                urllib.request.urlopen(urllib.request.Request(url, method="HEAD"), timeout=SECONDS).close()
            answers.append(True)

    thread = threading.Thread(target=request_head, daemon=True)
    thread.start()
    thread.join(SECONDS)
    return bool(answers)


# ---- torchvision, whose compiled library of PyPI is linked against the CUDA build of torch. With the CPU build its
# import fails with "operator torchvision::nms does not exist" while it registers shape functions. Encoders never call
# these operators: with their signatures declared the import succeeds.

# Operators exist as long as the library object that declared them.
_libraries: list[torch.library.Library] = []


def import_torchvision() -> None:
    """Import torchvision, declaring the missing operators only if the import fails without them.

    A compiled library that loads declares the operators itself, and a second declaration would be an error, so the
    import is tried first.
    """
    try:
        importlib.import_module("torchvision")
    except RuntimeError as error:
        if "torchvision::" not in str(error) or _libraries:
            raise
        library = torch.library.Library("torchvision", "DEF")
        for name in ("nms", "qnms"):
            if not hasattr(torch.ops.torchvision, name):
                library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        _libraries.append(library)
        importlib.import_module("torchvision")
