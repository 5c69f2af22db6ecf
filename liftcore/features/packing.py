"""Packing: folders of features and masks in common formats, and packs under other names, written as feature packs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_args

from liftcore.errors import InvalidFeatures, InvalidInput, reading
from liftcore.features.folders import Layout, ViewFolder, array_views, folders_of, langsplat_views
from liftcore.features.masks import mask_files, mask_views
from liftcore.features.prompts import Unannotated, prompt_views
from liftcore.io.files import check_output, whole_file, writing
from liftcore.io.photos import orientation_warnings
from liftcore.io.safetensors_file import with_metadata
from liftcore.runtime.arguments import as_path, check_choice, one_of
from liftcore.runtime.progress import Progress, shown_progress
from liftcore.text import OWN_WORDS
from liftcore.values.fit import FITS
from liftcore.values.pack import read_features, write_pack

OPTIONS = {  # of each kind of files
    "langsplat": (),
    "npy": ("layout", "map_fit"),
    "masks": ("unlabelled", "encoder", "photos", "device"),
    "prompts": ("unlabelled", "names", "unannotated"),
}
CHOICES = {"layout": get_args(Layout), "map_fit": FITS, "unannotated": get_args(Unannotated)}
NAMES = ("encoder", "text_space")  # of a pack


def pack_folder(
    folder: Path | str,
    out: Path | str,
    kind: Literal["langsplat", "npy", "masks", "prompts"],
    *,
    encoder_name: str | None = None,
    text_space: str | None = None,
    normalised: bool | None = None,
    progress: Progress | bool | None = None,
    **options: Any,
) -> dict[str, Any]:
    """Write a folder of features or masks as a feature pack, completely or not at all.

    Args:
        folder: of the files. out: path of the pack.
        kind: of the files, as for the command ``pack``.
        encoder_name, text_space, normalised: metadata of the pack; None: as recorded by the files or the encoder.
        progress: as for `liftcore.lift`.
        options: of the kind.
            ``npy``: ``layout``, the order of the axes, hwc or chw; ``map_fit``, what the encoder's preprocessing did
            to photos (`liftcore.values.fit`).
            ``masks``: ``unlabelled``, the value of pixels without a mask in label pictures (0); of masks without
            vectors ``encoder``, of each mask's crop of its photo, with ``photos`` and ``device``, as torch names it.
            ``prompts``: ``unlabelled`` (no value), ``names`` and ``unannotated``, as for
            `liftcore.features.prompts.prompt_views`.

    Returns:
        A dictionary for JSON: ``folders`` that are part of view names, ``words`` in the pack, and ``warnings``.
        `liftcore.evaluate.inspect_file` describes the pack.

    Raises:
        InvalidInput: files are malformed or do not match each other, the pack cannot be written, an unknown kind, or
            an option of another kind.
        Unavailable: the encoder's weights, or the device, are not on this machine.
    """
    names = {"encoder": encoder_name or None, "text_space": text_space or None, "normalised": normalised}
    _check_options(kind, options, names)
    folder = as_path(folder, "folder")
    table, warnings = None, list[str]()
    with shown_progress(progress) as reporter:
        with reading(folder, InvalidFeatures, "a folder of features or masks"):
            if kind == "langsplat":
                views: ViewFolder[Any] = langsplat_views(folder)
            elif kind == "npy":
                views = array_views(folder, options.get("layout", "hwc"), options.get("map_fit", ""))
            elif kind == "prompts":
                value_names = None if options.get("names") is None else as_path(options["names"], "names")
                choices = {name: options[name] for name in ("unlabelled", "unannotated") if name in options}
                prompts = prompt_views(folder, value_names, **choices)
                views, table, warnings = prompts.views, prompts.table, [*prompts.warnings]
                names = {"encoder": encoder_name or "masks by prompt", "text_space": OWN_WORDS, "normalised": True}
            elif options.get("encoder") is not None:
                views, own_names, warnings = _encoded_masks(folder, out, options, normalised, reporter)
                names = own_names | {name: value for name, value in names.items() if value is not None}
            elif options.get("photos"):
                raise InvalidInput("encoder", expected="an encoder of the masks in the photos", got="none")
            else:
                views = mask_views(folder, options.get("unlabelled") or 0)
        check_output(out, views.inputs, "pack")
        texts = {name: value if isinstance(value, str) else str(value).lower() for name, value in names.items()}
        metadata = {"source": kind} | {name: text for name, text in texts.items() if names[name] is not None}
        with writing(out):
            file = as_path(out, "output")
            write_pack(file, views, metadata, reporter, table)
    return {"folders": folders_of(views), "words": list(table.words) if table else [], "warnings": warnings}


def _check_options(kind: str, options: Mapping[str, Any], names: Mapping[str, str | bool | None]) -> None:
    """Check the kind, that each option belongs to it and is one of its choices, and the names of the pack."""
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
            raise InvalidInput(
                name, expected="None for prompts, whose vectors are computed here", got=repr(value)[:80]
            )
        if name == "normalised":
            raise InvalidInput(name, expected="True, False or None", got=repr(value)[:80])
        _check_text("encoder_name" if name == "encoder" else name, value)


def _check_text(argument: str, value: object) -> None:
    if not isinstance(value, str) or not value.strip():
        raise InvalidInput(argument, expected="a non-empty text", got=repr(value)[:80])


def _encoded_masks(
    folder: Path, out: Path | str, options: Mapping[str, Any], normalised: bool | None, progress: Progress
) -> tuple[ViewFolder[Any], dict[str, Any], list[str]]:
    """Encode crops of masks, and return their views, the metadata of the vectors, and warnings."""
    from liftcore.features.encoders import device_named
    from liftcore.features.encoders.crops import CropEncoder, crop_vectors
    from liftcore.features.encoders.encode import find_images

    photos, unlabelled = options.get("photos"), options.get("unlabelled") or 0
    if normalised is False:
        raise InvalidInput("normalised", expected="True or None: vectors of crops are unit vectors", got="False")
    if not photos:
        raise InvalidInput("photos", expected="the photos of the masks, for the encoder", got="none")
    files, images = mask_files(folder), find_images(photos)
    check_output(out, [*files.values(), *images.values()], "pack")  # before the slow part
    encoder = CropEncoder.open(str(options.get("encoder")), device_named(options.get("device", "cpu")))
    vectors, readings = crop_vectors(files, images, encoder, unlabelled, progress)
    names = {"encoder": f"crops of masks, {encoder.name}", "text_space": encoder.text_space, "normalised": True}
    return mask_views(folder, unlabelled, vectors), names, orientation_warnings(readings, "masks and cameras")


def retag_pack(pack: Path | str, out: Path | str, names: Mapping[str, str]) -> None:
    """Write a feature pack with other names of its encoder or its text space, completely or not at all.

    Args:
        names: ``encoder`` and ``text_space``, or one of them.

    Raises:
        InvalidInput: no name or an unknown one, a file that is not a pack, or a path that cannot be written.
    """
    if not isinstance(names, Mapping) or not names:
        raise InvalidInput(
            "names", expected=f"names of {' or '.join(NAMES)}", got=repr(names)[:80] if names else "none"
        )
    for name, value in names.items():
        check_choice("names", name, NAMES)
        _check_text(name, value)
    pack = as_path(pack, "pack")
    check_output(out, [pack], "pack")
    read_features(pack)  # so that an invalid pack is an error before a file is created
    with writing(out), whole_file(as_path(out, "output")) as handle:
        handle.writelines(with_metadata(pack, names))
