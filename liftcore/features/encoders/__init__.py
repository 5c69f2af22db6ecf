"""Image encoders behind one protocol, from photos to grids of features, one cell a patch."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from liftcore.errors import InvalidInput, Unavailable

IMAGE_ENCODERS = ("maskclip:MODEL/TAG", "maskclip:MODEL@FILE", "timm:NAME", "timm:NAME@FILE")


@dataclass(frozen=True)
class Pixels:
    """Preprocessing of an encoder's images."""

    patch: int  # pixels, the side of a grid cell
    shorter: int  # pixels of an image's shorter side by default: the size in training
    mean: tuple[float, ...]  # of red, green and blue in 0..1, subtracted
    std: tuple[float, ...]  # divisor
    interpolation: str  # bicubic, bilinear, lanczos or nearest


class ImageEncoder(Protocol):
    """A map from images to dense features; cell (r, c) of a grid covers its patch of the image."""

    @property
    def name(self) -> str:
        """Name of the encoder, for the pack."""
        ...

    @property
    def text_space(self) -> str:
        """Text encoder that shares the space, by its specification (``query --encoder``); "none" if none does."""
        ...

    @property
    def pixels(self) -> Pixels:
        """Preprocessing of images: an object with the attributes of `Pixels`, ``patch`` to ``interpolation``."""
        ...

    @property
    def channels(self) -> int:
        """Number F of channels."""
        ...

    def encode(self, images: Tensor) -> Tensor:
        """Encode images [n, 3, h p, w p] f32, prepared by `pixels`, as grids [n, h, w, F] f32 on the CPU."""
        ...


def open_image_encoder(spec: str, device: str = "cpu") -> ImageEncoder:
    """Open an image encoder by its specification.

    | specification | features of a patch |
    |---|---|
    | ``maskclip:...`` | MaskCLIP (Zhou et al., ECCV 2022): the projected value of the last attention |
    | ``timm:...`` | the normalized token of the last block, or the last feature map of a convolutional network |

    Args:
        spec: one of ``IMAGE_ENCODERS``; weights by name are downloaded by the library, or read from its cache.
        device: as torch names it.
    """
    kind, _, rest = spec.partition(":")
    if not rest or kind not in ("maskclip", "timm"):
        hint = "SigLIP and MobileCLIP encode crops of masks ('pack masks --encoder'); maps of FeatUp: pack npy"
        raise InvalidInput("encoder", expected=f"one of {', '.join(IMAGE_ENCODERS)}", got=repr(spec), hint=hint)
    torch_device = device_named(device)
    if kind == "timm":
        from liftcore.features.encoders.timm_backbone import TimmEncoder

        return TimmEncoder.open(rest, torch_device)
    from liftcore.features.encoders.clip import ClipImageEncoder
    from liftcore.text.open_clip import open_model

    return ClipImageEncoder(open_model("maskclip", rest), torch_device)


def device_named(name: str) -> torch.device:
    """Return a device by torch's name of it."""
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:  # torch's errors for a missing device
        got = f"{name!r} ({str(error).splitlines()[0][:120]})"
        raise Unavailable("device", expected="a device that torch can use, such as cpu", got=got) from None
    return device
