"""Render mode of splats: how they were trained, from their files, and so how to render them.

Trainers and editors record it in four places: comments of a PLY (``SplatRenderMode: default | mip | 2dgs`` of Brush,
gsplat, nerfstudio and splat-transform, ``antialiased 0 | 1`` of Postshot), a flag of an SPZ, ``model`` in the
``meta.json`` of a SOG, and the configuration that a trainer leaves beside its checkpoints. Files without it are
classic ones, as nearly all were before.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from liftcore.errors import InvalidSplats
from liftcore.runtime.arguments import check_choice
from liftcore.scene.kernel import Kernel

BY_HAND = "set by hand"  # of `rendering_reason`: the setting was not auto


class RenderModel(StrEnum):
    """The mode in which a renderer must draw splats."""

    CLASSIC = "classic"  # Gaussians with the low-pass alone
    ANTIALIASED = "antialiased"  # and their opacity lowered as the low-pass widens them (the mip filter)
    DISCS = "2dgs"  # discs; a third scale is ignored


@dataclass(frozen=True)
class RenderMode:
    """A render mode, and its source."""

    model: RenderModel
    source: str  # its source, as the subject of a sentence


_BY_NAME = {  # as comments and ``meta.json`` spell them
    "default": RenderModel.CLASSIC,
    "classic": RenderModel.CLASSIC,
    "mip": RenderModel.ANTIALIASED,
    "antialiased": RenderModel.ANTIALIASED,
    "2dgs": RenderModel.DISCS,
}
_COMMENT = re.compile(
    r"comment\s+(splatrendermode:\s*(?P<mode>.*)|antialiased:?\s+(?P<flag>[01]|true|false))\s*", re.I
)
CONFIGS = ("cfg.yml", "config.yml")  # of gsplat's simple_trainer and of nerfstudio, beside or above what they train
MAX_CONFIG_BYTES = 1 << 18
_MAX_TEXT = 60  # characters of a file's words
_OF_GSPLAT = re.compile(r"^antialiased: *(true|false) *$", re.M)
_GSPLAT_DISCS = re.compile(r"^model_type: *2dgs *$", re.M)
_OF_NERFSTUDIO = re.compile(r"^ +rasterize_mode: *(classic|antialiased) *$", re.M)


def render_mode_of(mode: RenderMode | str | None) -> RenderMode | None:
    """Return the mode of a name: ``classic``, ``antialiased`` or ``2dgs``; None stays None."""
    if mode is None or isinstance(mode, RenderMode):
        return mode
    check_choice("render_mode", mode, RenderModel, InvalidSplats)
    return RenderMode(RenderModel(mode), f"render_mode={str(mode)!r}")


def kernel_of_mode(mode: RenderMode | None) -> Kernel:
    """Return the kernel of splats whose numbers may be of several."""
    return Kernel.GAUSSIAN_2D if mode is not None and mode.model is RenderModel.DISCS else Kernel.GAUSSIAN_3D


def mode_of_word(word: object, source: str) -> tuple[RenderMode | None, tuple[str, ...]]:
    """Return the mode that a word of a file names, and a warning where it names none."""
    model = _BY_NAME.get(word.strip().lower()) if isinstance(word, str) else None
    if model is None:
        return None, (f"{source} names a render mode that is not known: taken for classic",)
    return RenderMode(model, source), ()


def mode_of_comments(lines: Iterable[str]) -> tuple[RenderMode | None, tuple[str, ...]]:
    """Return the mode in the header lines of a PLY, the last of several, and warnings of contradictions."""
    modes: list[RenderMode] = []
    warnings: list[str] = []
    for line in lines:
        match = _COMMENT.fullmatch(line.strip())
        if match is None:
            continue
        source = f"the comment {line.strip()[8:].strip()[:_MAX_TEXT]!r}"
        flag = "mip" if (match["flag"] or "").lower() in ("1", "true") else "default"
        mode, mode_warnings = mode_of_word(flag if match["mode"] is None else match["mode"], source)
        modes += [mode] if mode else []
        warnings += mode_warnings
    if len({mode.model for mode in modes}) > 1:
        first, last = modes[0], modes[-1]
        warnings.append(f"{first.source} and {last.source} contradict each other: the last one is used")
    return (modes[-1] if modes else None), tuple(warnings)


def mode_beside(path: Path) -> RenderMode | None:
    """Return the mode of gsplat's or nerfstudio's configuration, in the folder of a trained file or its parent."""
    folder = path.resolve().parent
    for config in (place / name for place in (folder, folder.parent) for name in CONFIGS):
        text, is_gsplat = "", config.name == CONFIGS[0]
        with suppress(OSError):
            if config.is_file():
                with config.open("rb") as handle:
                    text = handle.read(MAX_CONFIG_BYTES).decode("latin-1").replace("\r\n", "\n")
        if is_gsplat and _GSPLAT_DISCS.search(text):
            return RenderMode(RenderModel.DISCS, f"'model_type: 2dgs' in {config.name}")
        if match := (_OF_GSPLAT if is_gsplat else _OF_NERFSTUDIO).search(text):
            model = RenderModel.ANTIALIASED if match[1] in ("true", "antialiased") else RenderModel.CLASSIC
            return RenderMode(model, f"{match[0].strip()!r} in {config.name}")
    return None


def rendering_reason(mode: RenderMode | None, antialiased: bool) -> str:
    """Describe the reason of a render mode; ``antialiased`` is the value in use."""
    if mode is None:
        return BY_HAND if antialiased else "nothing says otherwise"
    if (mode.model is RenderModel.ANTIALIASED) is antialiased:
        return f"{mode.source} says so"
    return f"{BY_HAND}, against {mode.source}"


def rendering_warnings(mode: RenderMode | None, antialiased: bool, kernel: Kernel) -> list[str]:
    """Warn if 3D Gaussians are rendered in another mode than they were trained in."""
    if mode is None or kernel is not Kernel.GAUSSIAN_3D or mode.model is RenderModel.DISCS:
        return []
    if (mode.model is RenderModel.ANTIALIASED) is antialiased:
        return []
    return [f"antialiased={str(antialiased).lower()} is set by hand, and {mode.source} says {mode.model}"]
