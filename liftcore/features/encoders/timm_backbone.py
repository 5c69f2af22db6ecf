"""Backbones of timm (DINO, DINOv2, ViT, ResNet and others), whose features have no text space."""

import sys
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor, nn

from liftcore.errors import InvalidInput, Unavailable
from liftcore.features.encoders import Pixels
from liftcore.runtime.arguments import nearest
from liftcore.text.open_clip import fetch_weights, library, require_weights

# Tensors of checkpoints besides the backbone, needed in training only.
_LEFT_OVER = ("mask_token",)
_PROBE = (2, 3)  # rows and columns of the grid that every encoder is tested with
_STRIDED = (nn.Conv2d, nn.MaxPool2d, nn.AvgPool2d)


class TimmEncoder:
    """Normalized patch tokens of the last block, or the last feature map (``ImageEncoder``)."""

    text_space = "none"

    def __init__(self, name: str, model: Any, device: torch.device) -> None:
        self.name = f"timm:{name}"
        self._model = model.to(device).float().eval()
        self._device = device
        self.pixels = _pixels(model)
        self._shift = 0.0
        self.channels = self._probe()

    @classmethod
    def open(cls, spec: str, device: torch.device) -> Self:
        """Load ``NAME`` (cached or downloaded by timm) or ``NAME@WEIGHTS_FILE`` (tensors only)."""
        name, at, file = spec.partition("@")
        label = f"encoder timm:{spec}"
        timm = library("timm")
        if not timm.is_model(name):
            hint = nearest(name, timm.list_models(), 3)
            raise InvalidInput(label, expected="a model of timm", got=repr(name), hint=hint)
        model = _from_file(label, name, Path(file)) if at else _by_name(label, name)
        return cls(name, model, device)

    def encode(self, images: Tensor) -> Tensor:
        """Encode images [n, 3, h p, w p] f32 as grids [n, h, w, F] f32 on the CPU."""
        with torch.inference_mode():
            images = images.to(self._device)
            if self._shift == 0:
                return self._cells(images)
            # A padding with the border's colours shifts the cells onto their patches (`cell_shift`); the row and the
            # column of cells outside of the images go.
            patch = self.pixels.patch
            before = round(-self._shift) % patch
            wider = nn.functional.pad(images, (before, patch - before, before, patch - before), mode="replicate")
            cells = self._cells(wider)
            return (cells[:, 1:, 1:] if self._shift > 0 else cells[:, :-1, :-1]).contiguous()

    def _cells(self, images: Tensor) -> Tensor:
        (cells,) = self._model.forward_intermediates(images, indices=1, norm=True, intermediates_only=True)
        return cells.permute(0, 2, 3, 1).to("cpu", torch.float32).clone(memory_format=torch.contiguous_format)

    def _probe(self) -> int:
        """Return F after a check that the model gives one cell a patch for images of any size."""
        rows, columns = _PROBE
        try:
            images = torch.zeros(1, 3, rows * self.pixels.patch, columns * self.pixels.patch, device=self._device)
            shift = cell_shift(self._model, images)
            self._shift = shift if abs(shift) >= 1 else 0.0
            shape = tuple(self.encode(images).shape)
            if shape[:3] == (1, rows, columns):
                return shape[3]
            got = f"a grid of {shape[1:3]} for {rows}x{columns} patches"
        except (AssertionError, RuntimeError, ValueError, AttributeError) as error:
            got = str(error)
        raise InvalidInput(
            "encoder",
            expected="a backbone that takes images of any size and gives a map of features",
            got=f"{self.name} ({got[:120]})",
            hint="ViT, DINO, DINOv2, ResNet, ConvNeXt and EfficientNet do",
        )


def _by_name(label: str, name: str) -> Any:
    config = library("timm").models.get_pretrained_cfg(name, allow_unregistered=False)
    if config is None or not config.has_weights:
        raise Unavailable(
            label, expected="weights: a name with weights in timm, or a file", got="none", hint=f"timm:{name}@FILE"
        )
    return fetch_weights(
        label,
        lambda: _create(name, pretrained=True),
        f"download the weights on another machine and use timm:{name}@FILE",
    )


def _from_file(label: str, name: str, path: Path) -> Any:
    require_weights(label, path)
    model = _create(name, pretrained=False)
    try:
        stored = library("timm").models.load_state_dict(str(path), device="cpu", weights_only=True)
        if not isinstance(stored, dict) or not all(isinstance(value, Tensor) for value in stored.values()):
            raise ValueError("not a mapping of names to tensors")
        # Modules of timm translate the names of the authors' checkpoints.
        translate = getattr(sys.modules[type(model).__module__], "checkpoint_filter_fn", None)
        state = translate(dict(stored), model) if translate else stored
        if not state.keys() & model.state_dict().keys():
            raise ValueError("tensors of other names: save the weights with timm's names")
        missing, unexpected = model.load_state_dict(state, strict=False)
    except Exception as error:  # readers of pickles and state dicts raise many types for files of other content
        raise _not_weights(label, name, path, str(error)) from None
    heads = model.pretrained_cfg.get("classifier") or ()
    heads = (heads,) if isinstance(heads, str) else tuple(heads)
    explained_prefixes = (*_LEFT_OVER, *(f"{head}." for head in heads), "fc_norm.")
    unexpected = [key for key in unexpected if not key.startswith(explained_prefixes)]
    if missing or unexpected:
        part = ", ".join([*(f"no {key}" for key in missing[:2]), *(f"an unexpected {key}" for key in unexpected[:2])])
        raise _not_weights(label, name, path, part)
    return model


def _not_weights(label: str, name: str, path: Path, got: str) -> InvalidInput:
    hint = "save the state_dict() of timm's model alone, as safetensors"
    return InvalidInput(label, expected=f"only tensors of {name} in {path.name}", got=got[:200], hint=hint)


def _create(name: str, *, pretrained: bool) -> Any:
    timm = library("timm")
    try:
        # With this option vision transformers resample their positions to the images' grid.
        return timm.create_model(name, pretrained=pretrained, num_classes=0, dynamic_img_size=True)
    except TypeError:
        return timm.create_model(name, pretrained=pretrained, num_classes=0)


def _pixels(model: Any) -> Pixels:
    from timm.data.config import resolve_data_config

    settings = resolve_data_config({}, model=model)
    return Pixels(
        patch=int(model.feature_info[-1]["reduction"]),
        shorter=min(settings["input_size"][1:]),
        mean=tuple(settings["mean"]),
        std=tuple(settings["std"]),
        interpolation=settings["interpolation"],
    )


def cell_shift(model: nn.Module, images: Tensor) -> float:
    """Measure the shift of cells up and left of the centres of their patches, in pixels; negative = down and right.

    Output i of a strided layer of kernel k, stride s and padding p is centred at ``s i + (k - 1) / 2 - p``, while the
    pixels that it covers are centred at ``s i + (s - 1) / 2``. So a 3 x 3 convolution of stride 2 and padding 1 is
    shifted by half a pixel up and left, and five of them, as in a ResNet, by 15.5 pixels: half a cell. Layers without
    a stride are assumed to be centred, as their padding makes them.

    For parallel layers (a block and its shortcut), the mean is used.

    Args:
        model: of timm, called by ``forward_intermediates``.
        images: [n, 3, H, W] f32, of any content; H a multiple of the stride of every layer.
    """
    at_scale: dict[int, list[float]] = {}  # input pixels a cell -> shifts of the strided layers there, in cells

    def note(module: Any, inputs: tuple[Tensor, ...], _: object) -> None:
        sizes = (module.kernel_size, module.stride, module.padding)
        kernel, stride, padding = (int(size if isinstance(size, int) else size[0]) for size in sizes)
        if type(module).__name__.endswith("Same"):  # TensorFlow's padding, which timm adds in the layer's call
            padding = max(kernel - stride, 0) // 2
        if stride > 1:
            scale = round(images.shape[-2] / inputs[0].shape[-2])
            at_scale.setdefault(scale, []).append((stride - 1) / 2 - ((kernel - 1) / 2 - padding))

    hooks = [module.register_forward_hook(note) for module in model.modules() if isinstance(module, _STRIDED)]
    try:
        with torch.inference_mode():
            model.forward_intermediates(images, indices=1, norm=True, intermediates_only=True)  # pyright: ignore
    finally:
        for hook in hooks:
            hook.remove()
    return sum(scale * sum(shifts) / len(shifts) for scale, shifts in at_scale.items())
