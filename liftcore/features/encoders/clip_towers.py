"""Dense features of CLIP's image towers: what the pooled embedding is made of, a patch at a time.

CLIP itself gives one vector an image. MaskCLIP (Zhou, Loy and Dai, ECCV 2022) takes away the pooling: the last
attention's values, each patch its own, go through the output layers alone, and stay in the space of the texts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch.nn import functional

if TYPE_CHECKING:
    from torch import Tensor


def vit_values(tower: Any, images: Tensor) -> Tensor:
    """MaskCLIP on open_clip's ViT: ``proj(ln_post(W_o (W_v ln_1(x) + b_v) + b_o))`` of the last block's input x.

    The last block's residual and its MLP are left out with the attention: they were trained on the class token's
    mixture, and the values alone stay local.

    Args:
        tower: open_clip's VisionTransformer of plain blocks, without an attention pooler.
        images: [n, 3, h p, w p] f32.

    Returns:
        [n, h, w, F] f32.
    """
    tokens = _embed(tower, images)
    *blocks, last = tower.transformer.resblocks
    for block in blocks:
        tokens = block(tokens)
    width = last.attn.embed_dim
    values = functional.linear(
        last.ln_1(tokens), last.attn.in_proj_weight[2 * width :], last.attn.in_proj_bias[2 * width :]
    )
    return _project(tower, last.attn.out_proj(values), images)


def vit_patches(tower: Any, images: Tensor) -> Tensor:
    """Plain CLIP on open_clip's ViT: ``proj(ln_post(x))`` of every patch's token x after the last block.

    Nothing in the training asks these tokens to answer for their patch; they mix in what the class token needs.
    Shapes are those of `vit_values`.
    """
    tokens = _embed(tower, images)
    for block in tower.transformer.resblocks:
        tokens = block(tokens)
    return _project(tower, tokens, images)


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
    """[n, 1 + h w, C], the tokens before the first block; positions are resampled to the images' grid."""
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


def _project(tower: Any, tokens: Tensor, images: Tensor) -> Tensor:
    features = tower.ln_post(tokens[:, 1:])
    if tower.proj is not None:
        features = features @ tower.proj
    rows, columns = (side // patch for side, patch in zip(images.shape[-2:], tower.patch_size, strict=True))
    return features.unflatten(1, (rows, columns))
