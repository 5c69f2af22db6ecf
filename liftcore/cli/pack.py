"""``splatlift pack``: the field's feature formats become feature packs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from liftcore.cli.bars import progress_bars
from liftcore.cli.reply import free_output, reply, shown, writing
from liftcore.cli.sub_folders import folders_of, told_folders

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterator
    from pathlib import Path

    from liftcore.features.folder import ViewFolder


def run(options: argparse.Namespace) -> int:
    """Write the pack whole or not at all, and say what is in it."""
    from liftcore.features.pack import open_packs
    from liftcore.features.write_pack import write_pack
    from liftcore.io.inspect import describe_packs

    views = _views(options)
    out = free_output(options.output, views.inputs)
    with progress_bars() as progress, writing(out):
        write_pack(out, views, _metadata(options), progress)
    packs = open_packs([out])
    described = describe_packs(packs)
    document = {
        "out": str(out),
        "bytes": out.stat().st_size,
        "views": len(packs.views),
        "channels": packs.channels,
        "encoder": packs.encoder,
        "text_space": packs.text_space,
        "normalised": packs.normalised,
        "folders": folders_of(views),
        "sizes": described["sizes"],
        "renamed": {} if options.format == "langsplat" else _renamed(views, options.folder),
        "warnings": described["warnings"],
    }
    reply(document, as_json=options.json, lines=_lines(document))
    return 0


def _renamed(views: ViewFolder, folder: Path) -> dict[str, str]:
    """The views that lost the suffix of an image, by their files."""
    files = {path.relative_to(folder).as_posix(): view for view, path in views.files.items()}
    return {name: view for name, view in files.items() if name != f"{view}.npy"}


def _lines(document: dict[str, Any]) -> Iterator[str]:
    yield f"{document['out']}: {document['views']} views, {document['channels']} channels, {document['bytes']} bytes"
    yield f"  {shown(document['sizes'])}"
    yield from told_folders(document["folders"])
    for name, view in list(document["renamed"].items())[:1]:
        yield f"  views are named without the suffix of their images, as cameras are: {name} is {view!r}"
    yield from (f"warning: {warning}" for warning in document["warnings"])


def _views(options: argparse.Namespace) -> ViewFolder:
    if options.format == "langsplat":
        from liftcore.io.langsplat import langsplat_views

        return langsplat_views(options.folder)
    if options.format == "masks":
        from liftcore.features.mask_folder import mask_views

        return mask_views(options.folder, options.unlabelled)
    from liftcore.features.arrays import array_views

    return array_views(options.folder, options.layout)


def _metadata(options: argparse.Namespace) -> dict[str, str]:
    metadata = {"source": options.format}
    if options.encoder_name:
        metadata["encoder"] = options.encoder_name
    if options.text_space:
        metadata["text_space"] = options.text_space
    if options.normalised is not None:
        metadata["normalised"] = "true" if options.normalised else "false"
    return metadata
