"""Folders in the field's formats of features and masks, and packs under other names, written as feature packs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict, Unpack, get_args

from liftcore.errors import InvalidInput
from liftcore.features.folders import Layout, ViewFolder, array_views, folders_of, langsplat_views
from liftcore.features.masks import mask_files, mask_views
from liftcore.features.prompts import Folders, Unannotated, prompt_views
from liftcore.io.files import whole_file
from liftcore.io.outputs import check_output, writing
from liftcore.io.photos import orientation_warnings
from liftcore.io.remote import landing, local_path
from liftcore.io.safetensors_file import with_metadata
from liftcore.runtime.arguments import check_choice, check_text, one_of
from liftcore.runtime.progress import Progress, shown_progress
from liftcore.scene.views import IMAGE_SUFFIXES
from liftcore.text import OWN_WORDS
from liftcore.values.pack import read_features, write_pack

if TYPE_CHECKING:
    from liftcore.text.table import TableEncoder

SHOWN = 6  # phrases in a warning
OPTIONS = {  # of the kinds of files
    "langsplat": (),
    "npy": ("layout",),
    "masks": ("unlabelled", "encoder", "photos", "device"),
    "prompts": ("unlabelled", "names", "folders", "unannotated"),
}
CHOICES = {"layout": get_args(Layout), "folders": get_args(Folders), "unannotated": get_args(Unannotated)}
LANGSPLAT_LEVELS = ("default", "s", "m", "l")  # SAM's masks, then subparts, parts and wholes
NAMES = ("encoder", "text_space")  # of a pack


class PackOptions(TypedDict, total=False):
    """How files of one format are read."""

    layout: Layout
    """of ``npy``, the order of the axes: hwc or chw"""
    unlabelled: int | None
    """of label pictures, the value that means no mask; None: 0 of ``masks``, and none of ``prompts``"""
    encoder: str | None
    """of ``masks`` without vectors, what makes them of each mask's crop of its photo"""
    photos: Path | str | Sequence[Path | str] | None
    """of ``encoder``"""
    device: str
    """of ``encoder``, as torch names it"""
    names: Path | str | None
    """of ``prompts``, as `liftcore.features.prompts.prompt_views` has it; like ``folders`` and ``unannotated``"""
    folders: Folders
    unannotated: Unannotated


def pack_folder(
    folder: Path | str,
    out: Path | str,
    kind: Literal["langsplat", "npy", "masks", "prompts"],
    *,
    encoder_name: str | None = None,
    text_space: str | None = None,
    normalised: bool | None = None,
    progress: Progress | bool | None = None,
    **options: Unpack[PackOptions],
) -> dict[str, Any]:
    """Write a folder of features or masks as a feature pack, whole or not at all.

    Args:
        folder: of the files. out: the pack to write.
        kind: of the files, as the command ``pack`` tells them apart.
        encoder_name, text_space, normalised: what the pack says of its vectors; None: what is known of them.
        progress: as `liftcore.lift` has it.
        options: of the kind.

    Returns:
        Plain facts, ready for JSON: ``folders`` that are part of names, views that were ``renamed``, ``words`` that
        came along, and ``warnings``. `liftcore.evaluate.inspect_file` describes the pack.

    Raises:
        InvalidInput: files are malformed or do not fit each other, the pack cannot be written, there is no such kind,
            or an option is none of the kind.
        Unavailable: the encoder's weights, or the device, are not on this machine.
    """
    names = {"encoder": encoder_name or None, "text_space": text_space or None, "normalised": normalised}
    _check_options(kind, options, names)
    folder = local_path(folder, "folder")
    table, warnings, is_encoded = None, list[str](), False
    with shown_progress(progress) as reporter:
        if kind == "langsplat":
            views: ViewFolder[Any] = langsplat_views(folder)
        elif kind == "npy":
            views = array_views(folder, options.get("layout", "hwc"))
        elif kind == "prompts":
            views, table, warnings = _prompt_views(folder, options)
            names = {"encoder": encoder_name or "masks by prompt", "text_space": OWN_WORDS, "normalised": True}
        elif options.get("encoder") is not None:
            views, own_names, warnings = _encoded_masks(folder, out, options, normalised, reporter)
            names = own_names | {name: value for name, value in names.items() if value is not None}
            is_encoded = True
        elif options.get("photos"):
            raise InvalidInput("encoder", expected="what makes vectors of the masks in the photos", got="none")
        else:
            views = mask_views(folder, options.get("unlabelled") or 0)
        check_output(out, views.inputs, "pack")
        texts = {name: value if isinstance(value, str) else str(value).lower() for name, value in names.items()}
        metadata = {"source": kind} | {name: text for name, text in texts.items() if names[name] is not None}
        if kind == "langsplat" and len(views[next(iter(views))].labels) == len(LANGSPLAT_LEVELS):
            metadata["levels"] = json.dumps(LANGSPLAT_LEVELS)
        with writing(out), landing(out) as file:
            write_pack(file, views, metadata, reporter, table)
    keeps = kind in ("langsplat", "prompts") or is_encoded  # their files are not named after images
    return {
        "folders": folders_of(views),
        "renamed": {} if keeps else _renamed(views, folder),
        "words": list(table.words) if table else [],
        "warnings": warnings,
    }


def _check_options(kind: str, options: PackOptions, names: Mapping[str, str | bool | None]) -> None:
    """Refuse a kind that is none, an option of another, a choice that is none, and names that do not fit."""
    check_choice("kind", kind, OPTIONS)
    for name, value in options.items():
        if name not in OPTIONS[kind]:
            expected = f"{one_of(OPTIONS[kind]) if OPTIONS[kind] else 'no option'} of {kind}"
            raise InvalidInput(name, expected=expected, got=repr(value)[:80])
        if name in CHOICES:
            check_choice(name, value, CHOICES[name])
    for name, value in names.items():
        if value is None or (name == "normalised" and isinstance(value, bool) and kind != "prompts"):
            continue
        if kind == "prompts" and name != "encoder":
            raise InvalidInput(name, expected="None for prompts, whose vectors are made here", got=repr(value)[:80])
        if name == "normalised":
            raise InvalidInput(name, expected="True, False or None", got=repr(value)[:80])
        check_text("encoder_name" if name == "encoder" else name, value)


def _prompt_views(folder: Path, options: PackOptions) -> tuple[ViewFolder[Any], TableEncoder, list[str]]:
    """The views, the words that they bring, and warnings."""
    names = options.get("names")
    prompts = prompt_views(
        folder,
        None if names is None else local_path(names, "names"),
        options.get("folders", "phrases"),
        unlabelled=options.get("unlabelled"),
        unannotated=options.get("unannotated", "skip"),
    )
    empty = [phrase for phrase, views in prompts.counts.items() if not views]
    some = ", ".join(empty[:SHOWN]) + (f", ... ({len(empty)})" if len(empty) > SHOWN else "")
    warnings = [f"no view has a mask of {some}: left out"] if empty else []
    return prompts.views, prompts.table, [*prompts.warnings, *warnings]


def _encoded_masks(
    folder: Path, out: Path | str, options: PackOptions, normalised: bool | None, progress: Progress
) -> tuple[ViewFolder[Any], dict[str, Any], list[str]]:
    """Masks with vectors of their crops, what is known of these, and warnings."""
    from liftcore.features.encoders import device_named
    from liftcore.features.encoders.crops import CropEncoder, crop_vectors
    from liftcore.features.encoders.encode import find_images

    photos, unlabelled = options.get("photos"), options.get("unlabelled") or 0
    if normalised is False:
        raise InvalidInput("normalised", expected="unit vectors, which the encoder makes", got="False")
    if not photos:
        raise InvalidInput("photos", expected="the photos that the masks are of, for the encoder", got="none")
    files, images = mask_files(folder), find_images(photos)
    check_output(out, [*files.values(), *images.values()], "pack")  # before the work
    encoder = CropEncoder.open(str(options.get("encoder")), device_named(options.get("device", "cpu")))
    vectors, readings = crop_vectors(files, images, encoder, unlabelled, progress)
    names = {"encoder": f"crops of masks, {encoder.name}", "text_space": encoder.text_space, "normalised": True}
    return mask_views(folder, unlabelled, vectors), names, orientation_warnings(readings, "masks and cameras")


def _renamed(views: ViewFolder[Any], folder: Path) -> dict[str, str]:
    """The views that lost the suffix of an image, by their files of vectors."""
    files = {path.relative_to(folder).as_posix(): view for view, path in views.files.items()}
    return {name: view for name, view in files.items() if Path(name).with_suffix("").suffix.lower() in IMAGE_SUFFIXES}


def retag_pack(pack: Path | str, out: Path | str, names: Mapping[str, str]) -> None:
    """Write a feature pack under other names of its encoder or its text space, whole or not at all.

    Args:
        names: ``encoder`` and ``text_space``, or one of them.

    Raises:
        InvalidInput: there is no name or an unknown one, the pack is none, or it cannot be written.
    """
    if not isinstance(names, Mapping) or not names:
        raise InvalidInput(
            "names", expected=f"names of {' or '.join(NAMES)}", got=repr(names)[:80] if names else "none"
        )
    for name, value in names.items():
        check_choice("names", name, NAMES)
        check_text(name, value)
    pack = local_path(pack, "pack")
    check_output(out, [pack], "pack")
    read_features(pack)  # what is no pack leaves no file
    with writing(out), landing(out) as file, whole_file(file) as handle:
        handle.writelines(with_metadata(pack, names))
