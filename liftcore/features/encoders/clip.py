"""CLIP's image towers as encoders whose features share a space with texts.

CLIP itself gives one vector for an image. MaskCLIP (Zhou, Loy and Dai, ECCV 2022) removes the pooling: the value of
each patch in the last attention goes through the output layers, and stays in the space of the texts.

Towers with a trunk of timm (SigLIP, SigLIP 2, MobileCLIP, ConvNeXt) pool after the trunk: there each cell goes
separately through the tower's own pooling and head. For SigLIP's attention pooling this is the value path, as in
MaskCLIP; a mean over cells becomes the identity.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor
from torch.nn import functional

from liftcore.errors import InvalidInput
from liftcore.features.encoders import Pixels
from liftcore.text.open_clip import OpenedModel, create_model, library, open_model

RESNET_PATCH = 32  # pixels, the stride of a ResNet's last feature map


class ClipImageEncoder:
    """Dense features of open_clip models (``ImageEncoder``), by MaskCLIP or from the last block's tokens."""

    def __init__(self, kind: str, clip_model: OpenedModel, text_space: str, device: torch.device) -> None:
        self.name = f"{kind}:{clip_model.name.removeprefix('open_clip:')}"
        self.text_space = text_space
        self._tower = clip_model.model.visual.to(device).float().eval()
        self._device = device
        self._dense = _dense(kind, clip_model.model_name, self._tower)
        self.pixels = _pixels(clip_model.model, self._tower)
        with torch.inference_mode():
            probe = self._dense(self._tower, torch.zeros(1, 3, self.pixels.patch, self.pixels.patch, device=device))
        self.channels = int(probe.shape[-1])

    @classmethod
    def open(cls, kind: str, spec: str, device: torch.device) -> Self:
        """Load ``MODEL/PRETRAINED_TAG`` or ``MODEL@WEIGHTS_FILE`` for ``maskclip`` or ``clip``.

        Raises:
            InvalidInput: an unknown model, an unsupported image tower, or a file without weights of the model.
            Unavailable: the specification has no weights, or they are not available here.
        """
        clip_model = open_model(kind, spec)
        return cls(kind, clip_model, space_of(clip_model, spec), device)

    @classmethod
    def _with_random_weights(cls, kind: str, model_name: str) -> Self:
        """Create an encoder with random weights of the right shapes, for tests only."""
        clip_model = OpenedModel(f"open_clip:{model_name} (random)", model_name, create_model(model_name, None))
        return cls(kind, clip_model, "none", torch.device("cpu"))

    def encode(self, images: Tensor) -> Tensor:
        """Encode images [n, 3, h p, w p] f32 as grids [n, h, w, F] f32 on the CPU."""
        with torch.inference_mode():
            return self._dense(self._tower, images.to(self._device)).to("cpu", torch.float32).clone()


def space_of(clip_model: OpenedModel, spec: str) -> str:
    """Return the text space of a model: its name, with the path of a file of weights, as queries open it."""
    _, at, file = spec.partition("@")
    return f"{clip_model.name}@{Path(file).resolve()}" if at else clip_model.name


def _dense(kind: str, model_name: str, tower: Any) -> Callable[[Any, Tensor], Tensor]:
    library()
    from open_clip.modified_resnet import ModifiedResNet
    from open_clip.timm_model import TimmModel
    from open_clip.transformer import ResidualAttentionBlock, VisionTransformer

    if isinstance(tower, TimmModel):
        return _trunk(kind, model_name, tower)
    if isinstance(tower, ModifiedResNet):
        if kind == "clip":
            raise InvalidInput(
                "encoder",
                expected="a ViT for clip:, whose patches have tokens",
                got=model_name,
                hint=f"maskclip:{model_name}... gives a ResNet's dense features",
            )
        return resnet_values
    # Exactly these classes, as subclasses have other layers on the value path.
    is_standard_vit = type(tower) is VisionTransformer and tower.attn_pool is None
    if not is_standard_vit or any(type(block) is not ResidualAttentionBlock for block in tower.transformer.resblocks):
        raise InvalidInput(
            "encoder",
            expected="a CLIP model with open_clip's own ViT or ResNet as image tower, without an attention pooler",
            got=f"{model_name} with {type(tower).__name__}",
        )
    return vit_values if kind == "maskclip" else vit_patches


def _trunk(kind: str, model_name: str, tower: Any) -> Callable[[Any, Tensor], Tensor]:
    """Return `trunk_cells` after a check that the tower gives one cell a patch for images of any size."""
    if kind == "maskclip" and getattr(tower.trunk, "global_pool", "") == "token":
        hint = f"clip:{model_name}... takes the patches' tokens through the class token's layers"
        expected, got = "a tower that pools its cells for maskclip:", f"{model_name}, which reads its class token"
        raise InvalidInput("encoder", expected=expected, got=got, hint=hint)
    if getattr(tower.trunk, "dynamic_img_size", True) is False:  # positions are then resampled to an image's grid
        tower.trunk.dynamic_img_size, tower.trunk.patch_embed.strict_img_size = True, False
        tower.trunk.patch_embed.flatten, tower.trunk.patch_embed.output_fmt = False, "NHWC"
    patch = _trunk_patch(tower)
    try:
        with torch.inference_mode():
            shape = tuple(trunk_cells(tower, torch.zeros(1, 3, 2 * patch, 3 * patch, device=_place(tower))).shape)
        if shape[:3] == (1, 2, 3):
            return trunk_cells
        got = f"a grid of {shape[1:3]} for 2x3 patches"
    except (AssertionError, RuntimeError, ValueError, AttributeError, IndexError, TypeError) as error:
        got = str(error)
    raise InvalidInput(
        "encoder",
        expected="a tower that gives one cell a patch for images of any size",
        got=f"{model_name} ({got[:120]})",
        hint="encode crops of masks with it: 'splatlift pack masks'",
    )


def _trunk_patch(tower: Any) -> int:
    return int(tower.trunk.feature_info[-1]["reduction"])


def _place(tower: Any) -> torch.device:
    return next(tower.parameters()).device


def training_pixels(model: Any, tower: Any) -> tuple[int, tuple[float, ...], tuple[float, ...], str]:
    """Return the shorter side of a model's training images, mean and deviation of its colours, and interpolation."""
    from open_clip.transform import PreprocessCfg

    config = library().get_model_preprocess_cfg(model)
    size = config.get("size") or tower.image_size
    settings = vars(PreprocessCfg()) | config  # with open_clip's defaults
    shorter = size if isinstance(size, int) else min(size)
    return int(shorter), tuple(settings["mean"]), tuple(settings["std"]), settings["interpolation"] or "bicubic"


def _pixels(model: Any, tower: Any) -> Pixels:
    patch = getattr(tower, "patch_size", (RESNET_PATCH, RESNET_PATCH))
    patch = (_trunk_patch(tower),) if hasattr(tower, "trunk") else patch
    return Pixels(int(patch[0]), *training_pixels(model, tower))


def vit_values(tower: Any, images: Tensor) -> Tensor:
    """MaskCLIP on open_clip's ViT: ``proj(ln_post(W_o (W_v ln_1(x) + b_v) + b_o))`` of the last block's input x.

    The last block's residual and MLP are omitted with its attention: they were trained on the class token, and only
    the values are local.

    Args:
        tower: open_clip's VisionTransformer of standard blocks, without an attention pooler.
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
    """CLIP on open_clip's ViT: ``proj(ln_post(x))`` of every patch's token x after the last block.

    The training does not tie these tokens to their patch, so they also contain information for the class token.
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


def trunk_cells(tower: Any, images: Tensor) -> Tensor:
    """Encode each cell of a timm trunk separately by the tower's pooling and head.

    A softmax over one cell is one, so an attention pooling gives ``x + mlp(norm(x))`` of
    ``x = W_o (W_v cell + b_v) + b_o``. If the tower has a mean and then linear layers, the mean over the cells is the
    image's vector.

    Args:
        tower: open_clip's TimmModel. images: [n, 3, h p, w p] f32.

    Returns:
        [n, h, w, F] f32.
    """
    trunk, patch = tower.trunk, _trunk_patch(tower)
    feature_map = trunk.forward_features(images)
    rows, columns = (side // patch for side in images.shape[-2:])
    if feature_map.ndim == 4:  # a feature map
        single_cells = feature_map.permute(0, 2, 3, 1).reshape(-1, feature_map.shape[1], 1, 1)
    else:  # tokens; the pooling skips the prefix tokens, so copies of the cell are in their place
        before = trunk.num_prefix_tokens
        single_cells = feature_map[:, before:].reshape(-1, 1, feature_map.shape[-1]).expand(-1, before + 1, -1)
    cells = tower.head(trunk.forward_head(single_cells))
    return cells.reshape(len(images), rows, columns, -1)


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


def _project(tower: Any, tokens: Tensor, images: Tensor) -> Tensor:
    features = tower.ln_post(tokens[:, 1:])
    if tower.proj is not None:
        features = features @ tower.proj
    rows, columns = (side // patch for side, patch in zip(images.shape[-2:], tower.patch_size, strict=True))
    return features.unflatten(1, (rows, columns))
