"""``splatlift check``: do splats, cameras, photos and features belong together?"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from liftcore.cli.options import BAD_INPUT, Parser
from liftcore.cli.reply import free_output, progress_bars, reply, writing

if TYPE_CHECKING:
    from collections.abc import Iterable

    from liftcore.evaluate.check import CheckReport


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    parser.add_argument("splats", type=Path, help="trained splats")
    parser.add_argument("cameras", type=Path, help="COLMAP folder or .zip, transforms.json or cameras.json")
    parser.add_argument("others", type=Path, nargs="*", help="folders of photos, and feature packs (.safetensors)")
    parser.add_argument("--worst", type=Path, metavar="PNG", help="write the worst view: its photo and the render")


def run(options: argparse.Namespace) -> int:
    """Look, and say what is wrong; the exit status is 2 if something is."""
    from liftcore.evaluate.check import check_scene
    from liftcore.features.encoders.encode import find_images
    from liftcore.features.pack import read_features
    from liftcore.io.cameras import read_cameras
    from liftcore.io.splats import read_splats

    if options.worst:
        free_output(options.worst, [options.splats])
    packs = [path for path in options.others if path.suffix == ".safetensors"]
    photos = [path for path in options.others if path not in packs]
    with progress_bars() as progress:
        found = check_scene(
            read_splats(options.splats),
            read_cameras(options.cameras),
            find_images(photos) if photos else None,
            read_features(*packs) if packs else None,
            progress,
        )
    document = {name: value for name, value in asdict(found).items() if name != "worst"}
    document["healthy"] = not found.wrong
    if options.worst and found.worst is not None:
        with writing(options.worst):
            options.worst.write_bytes(found.worst)
        document["worst"] = str(options.worst)
    reply(document, as_json=options.json, lines=_lines(found, document))
    return BAD_INPUT if found.wrong else 0


def _lines(found: CheckReport, document: dict) -> Iterable[str]:
    for view in found.views:
        compared = "" if view.psnr is None else f", {view.psnr:.1f} dB to its photo"
        control = "" if view.others is None else f" and {view.others:.1f} to others"
        yield f"  {view.view}: row sums {view.row_sum:.3f}{compared}{control}"
    yield f"  {found.in_view:.1%} of the splats are in some view"
    yield from (f"  features, {name.replace('_', ' ')}: {value:.3f}" for name, value in found.features.items())
    yield from (f"note: {text}" for text in found.notes)
    yield from (f"wrong: {text}" for text in found.wrong)
    if "worst" in document:
        yield f"  worst: {document['worst']}"
    yield "something is wrong" if found.wrong else "healthy: nothing contradicts anything that was given"
