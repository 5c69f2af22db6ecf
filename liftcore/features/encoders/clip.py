"""CLIP's image towers as encoders whose features share a space with texts.

CLIP itself gives one vector for an image. MaskCLIP (Zhou, Loy and Dai, ECCV 2022) removes the pooling: the value of
each patch in the last attention goes through the output layers, and stays in the space of the texts.

Other towers (SigLIP, MobileCLIP, ConvNeXt) encode crops of masks (`liftcore.features.encoders.crops`).
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from liftcore.errors import InvalidInput
from liftcore.features.encoders import Pixels
from liftcore.text.open_clip import OpenedModel, library

RESNET_PATCH = 32  # pixels, the stride of a ResNet's last feature map


class ClipImageEncoder:
    """Dense features of open_clip models by MaskCLIP (``ImageEncoder``)."""

    def __init__(self, clip_model: OpenedModel, device: torch.device) -> None:
        self.name = f"maskclip:{clip_model.name.removeprefix('open_clip:')}"
        self.text_space = clip_model.text_space
        self._tower = clip_model.model.visual.to(device).float().eval()
        self._device = device
        self._dense = _dense(clip_model.model_name, self._tower)
        patch = getattr(self._tower, "patch_size", (RESNET_PATCH, RESNET_PATCH))[0]
        self.pixels = Pixels(int(patch), *training_pixels(clip_model.model, self._tower))
        with torch.inference_mode():
            probe = self._dense(self._tower, torch.zeros(1, 3, self.pixels.patch, self.pixels.patch, device=device))
        self.channels = int(probe.shape[-1])

    def encode(self, images: Tensor) -> Tensor:
        """Encode images [n, 3, h p, w p] f32 as grids [n, h, w, F] f32 on the CPU."""
        with torch.inference_mode():
            return self._dense(self._tower, images.to(self._device)).to("cpu", torch.float32).clone()


def _dense(model_name: str, tower: Any) -> Callable[[Any, Tensor], Tensor]:
    library()
    from open_clip.modified_resnet import ModifiedResNet
    from open_clip.transformer import ResidualAttentionBlock, VisionTransformer

    if isinstance(tower, ModifiedResNet):
        return resnet_values
    # Exactly these classes, as subclasses have other layers on the value path.
    is_standard_vit = type(tower) is VisionTransformer and tower.attn_pool is None
    if not is_standard_vit or any(type(block) is not ResidualAttentionBlock for block in tower.transformer.resblocks):
        raise InvalidInput(
            "encoder",
            expected="a CLIP model with open_clip's own ViT or ResNet as image tower, without an attention pooler",
            got=f"{model_name} with {type(tower).__name__}",
            hint="encode crops of masks with it: 'splatlift pack masks --encoder'",
        )
    return vit_values


def training_pixels(model: Any, tower: Any) -> tuple[int, tuple[float, ...], tuple[float, ...], str]:
    """Return the shorter side of a model's training images, mean and deviation of its colours, and interpolation."""
    from open_clip.transform import PreprocessCfg

    config = library().get_model_preprocess_cfg(model)
    size = config.get("size") or tower.image_size
    settings = vars(PreprocessCfg()) | config  # with open_clip's defaults
    shorter = size if isinstance(size, int) else min(size)
    return int(shorter), tuple(settings["mean"]), tuple(settings["std"]), settings["interpolation"] or "bicubic"


def vit_values(tower: Any, images: Tensor) -> Tensor:
    """MaskCLIP on open_clip's ViT: ``proj(ln_post(W_o (W_v ln_1(x) + b_v) + b_o))`` of the last block's input x.

    Images [n, 3, h p, w p] become [n, h, w, F], both f32. The last block's residual and MLP are omitted with its
    attention: they were trained on the class token, and only the values are local.
    """
    tokens = _embed(tower, images)
    *blocks, last = tower.transformer.resblocks
    for block in blocks:
        tokens = block(tokens)
    width = last.attn.embed_dim
    values = functional.linear(
        last.ln_1(tokens), last.attn.in_proj_weight[2 * width :], last.attn.in_proj_bias[2 * width :]
    )
    features = tower.ln_post(last.attn.out_proj(values)[:, 1:])
    if tower.proj is not None:
        features = features @ tower.proj
    rows, columns = (side // patch for side, patch in zip(images.shape[-2:], tower.patch_size, strict=True))
    return features.unflatten(1, (rows, columns))


def resnet_values(tower: Any, images: Tensor) -> Tensor:
    """MaskCLIP on open_clip's ModifiedResNet: ``W_c (W_v x + b_v) + b_c`` of every cell x of the last feature map.

    Shapes are those of `vit_values`, with p = 32.
    """
    cells = tower.stem(images)
    for layer in (tower.layer1, tower.layer2, tower.layer3, tower.layer4):
        cells = layer(cells)
    pool = tower.attnpool
    return pool.c_proj(pool.v_proj(cells.permute(0, 2, 3, 1)))


def _embed(tower: Any, images: Tensor) -> Tensor:
    """Embed images as tokens [n, 1 + h w, C] before the first block, with positions resampled to the images' grid."""
    patches = tower.conv1(images)
    rows, columns = patches.shape[-2:]
    patches = patches.flatten(2).transpose(1, 2)
    head = tower.class_embedding.expand(len(images), 1, -1)
    tokens = torch.cat([head, patches], dim=1) + _positions(tower, rows, columns)
    return tower.ln_pre(tokens)


def _positions(tower: Any, rows: int, columns: int) -> Tensor:
    stored = tower.positional_embedding
    if (rows, columns) == tuple(tower.grid_size):
        return stored
    grid = stored[1:].T.reshape(1, -1, *tower.grid_size)
    grid = functional.interpolate(grid, (rows, columns), mode="bicubic", antialias=True, align_corners=False)
    return torch.cat([stored[:1], grid[0].flatten(1).T])
