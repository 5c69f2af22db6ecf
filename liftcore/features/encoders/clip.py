"""CLIP's image towers as encoders whose features share a space with texts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import torch

from liftcore.errors import InvalidInput
from liftcore.features.encoders import Pixels
from liftcore.features.encoders.clip_towers import resnet_values, vit_patches, vit_values
from liftcore.query.encoders.open_clip_models import OpenedModel, create_model, library, open_model

if TYPE_CHECKING:
    from collections.abc import Callable

    from torch import Tensor

RESNET_PATCH = 32  # pixels, the stride of a ResNet's last feature map


class ClipImageEncoder:
    """Dense features of open_clip models (``ImageEncoder``): ViT and ModifiedResNet, by MaskCLIP or plainly."""

    def __init__(self, kind: str, opened: OpenedModel, text_space: str, device: torch.device) -> None:
        self.name = f"{kind}:{opened.name.removeprefix('open_clip:')}"
        self.text_space = text_space
        self._tower = opened.model.visual.to(device).float().eval()
        self._device = device
        self._dense = _dense(kind, opened.model_name, self._tower)
        self.pixels = _pixels(opened.model, self._tower)
        with torch.inference_mode():
            probe = self._dense(self._tower, torch.zeros(1, 3, self.pixels.patch, self.pixels.patch, device=device))
        self.channels = int(probe.shape[-1])

    @classmethod
    def open(cls, kind: str, spec: str, device: torch.device) -> Self:
        """Load ``MODEL/PRETRAINED_TAG`` or ``MODEL@WEIGHTS_FILE`` for ``maskclip`` or ``clip``.

        Raises:
            InvalidInput: an unknown model, one whose tower is neither, or a file that is not weights of it.
            Unavailable: no weights were named, or they cannot be had here.
        """
        opened = open_model(kind, spec)
        _, at, file = spec.partition("@")
        # Weights of a file have no name but their path: it is what the query side opens again.
        space = f"{opened.name}@{Path(file).resolve()}" if at else opened.name
        return cls(kind, opened, space, device)

    @classmethod
    def _with_random_weights(cls, kind: str, model_name: str) -> Self:
        """A model of the right shape that knows nothing: tests of plumbing only."""
        opened = OpenedModel(f"open_clip:{model_name} (random)", model_name, create_model(model_name, None))
        return cls(kind, opened, "none", torch.device("cpu"))

    def encode(self, images: Tensor) -> Tensor:
        """Images [n, 3, h p, w p] f32 -> grids [n, h, w, F] f32 on the CPU."""
        with torch.inference_mode():
            return self._dense(self._tower, images.to(self._device)).to("cpu", torch.float32).clone()


def _dense(kind: str, model_name: str, tower: Any) -> Callable[[Any, Tensor], Tensor]:
    library()
    from open_clip.modified_resnet import ModifiedResNet
    from open_clip.transformer import ResidualAttentionBlock, VisionTransformer

    if isinstance(tower, ModifiedResNet):
        if kind == "clip":
            raise InvalidInput(
                "--encoder",
                expected="a ViT for clip:, whose patches have tokens",
                got=model_name,
                hint=f"maskclip:{model_name}... gives a ResNet's dense features",
            )
        return resnet_values
    # Exactly these classes: their subclasses put other things where the value path would be read.
    plain = type(tower) is VisionTransformer and tower.attn_pool is None
    if not plain or any(type(block) is not ResidualAttentionBlock for block in tower.transformer.resblocks):
        raise InvalidInput(
            "--encoder",
            expected="a CLIP model with open_clip's own ViT or ResNet as image tower, without an attention pooler",
            got=f"{model_name} with {type(tower).__name__}",
        )
    return vit_values if kind == "maskclip" else vit_patches


def _pixels(model: Any, tower: Any) -> Pixels:
    from open_clip.transform import PreprocessCfg

    told = library().get_model_preprocess_cfg(model)
    size = told.get("size") or tower.image_size
    settings = vars(PreprocessCfg()) | told  # open_clip's defaults where the weights say nothing
    sides = (size, size) if isinstance(size, int) else tuple(size)
    patch = getattr(tower, "patch_size", (RESNET_PATCH, RESNET_PATCH))
    return Pixels(
        patch=int(patch[0]),
        shorter=min(sides),
        mean=tuple(settings["mean"]),
        std=tuple(settings["std"]),
        interpolation=settings["interpolation"] or "bicubic",
    )
