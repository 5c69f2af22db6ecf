"""Image encoders behind one protocol: photos in, grids of features out, a cell a patch."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from liftcore.errors import InvalidInput, Unavailable
from liftcore.runtime.plugins import find_plugin, plugin_names

IMAGE_ENCODERS = (
    "maskclip:MODEL/TAG",
    "maskclip:MODEL@FILE",
    "clip:MODEL/TAG",
    "clip:MODEL@FILE",
    "timm:NAME",
    "timm:NAME@FILE",
)
KINDS = ("maskclip", "clip", "timm")
PLUGINS = "splatlift.image_encoders"  # the entry points of other packages' encoders


@dataclass(frozen=True)
class Pixels:
    """How an encoder wants its images."""

    patch: int  # pixels, the side of a grid cell
    shorter: int  # pixels of an image's shorter side, unless asked otherwise: what the model was trained at
    mean: tuple[float, ...]  # of red, green and blue in 0..1, taken off
    std: tuple[float, ...]  # divided by
    interpolation: str  # bicubic, bilinear, lanczos or nearest


class ImageEncoder(Protocol):
    """Maps images to dense features; cell (r, c) of a grid covers its patch of the image."""

    @property
    def name(self) -> str:
        """What the encoder is, for the pack."""
        ...

    @property
    def text_space(self) -> str:
        """The text encoder that shares the space, as ``query --encoder`` opens it; "none" when there is none."""
        ...

    @property
    def pixels(self) -> Pixels:
        """How images are prepared."""
        ...

    @property
    def channels(self) -> int:
        """F."""
        ...

    def encode(self, images: Tensor) -> Tensor:
        """Images [n, 3, h p, w p] f32, prepared as `pixels` says -> grids [n, h, w, F] f32 on the CPU."""
        ...


def open_image_encoder(spec: str, device: str = "cpu") -> ImageEncoder:
    """Open an image encoder by its specification.

    | specification | features of a patch |
    |---|---|
    | ``maskclip:...`` | MaskCLIP (Zhou et al., ECCV 2022): what the last attention reads there, projected |
    | ``clip:...`` | the last block's token through the layers that the class token goes through |
    | both, of a tower with a timm trunk | each cell alone through the tower's own pooling and head |
    | ``timm:...`` | the normed token of the last block, or the last feature map of a convolutional network |

    Args:
        spec: one of ``IMAGE_ENCODERS``; weights by name are fetched by the library, or read from its cache. Or
            ``NAME`` or ``NAME:REST`` of a plugin (`liftcore.runtime.plugins`), which is called with the rest and the
            device.
        device: as torch names it.

    Raises:
        InvalidInput: the specification is none of these, or a file is not weights of the model.
        Unavailable: the weights, or the device, are not on this machine, or a plugin fails.
    """
    kind, _, rest = spec.partition(":")
    if kind not in KINDS and (plugin := find_plugin(PLUGINS, kind, KINDS)):
        needs = ("name", "text_space", "pixels", "channels", "encode")
        return plugin.call(rest, device_named(device), needs=needs)
    if not rest or kind not in KINDS:
        specs = [*IMAGE_ENCODERS, *(f"{name}:..." for name in plugin_names(PLUGINS) if name not in KINDS)]
        hint = "SigLIP, MobileCLIP and the like are maskclip:MODEL/TAG; maps of FeatUp and others come by pack npy"
        raise InvalidInput("encoder", expected=f"one of {', '.join(specs)}", got=repr(spec), hint=hint)
    where = device_named(device)
    if kind == "timm":
        from liftcore.features.encoders.timm_backbone import TimmEncoder

        return TimmEncoder.open(rest, where)
    from liftcore.features.encoders.clip import ClipImageEncoder

    return ClipImageEncoder.open(kind, rest, where)


def device_named(name: str) -> torch.device:
    """A device as torch names it.

    Raises:
        Unavailable: torch has none of that name here.
    """
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:  # torch's kinds for a device it lacks
        got = f"{name!r} ({str(error).splitlines()[0][:120]})"
        raise Unavailable("device", expected="a device that torch has here, as cpu", got=got) from None
    return device
