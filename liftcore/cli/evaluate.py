"""``splatlift evaluate``, ``inspect``, ``check`` and ``tradeoff``: the views of `liftcore.evaluate`."""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from liftcore.cli import options as common
from liftcore.cli.lift import pairs_of
from liftcore.cli.query import FIELD_OVERRIDES
from liftcore.cli.reply import check_outputs, outputs_of, reply, write_files

if TYPE_CHECKING:
    from collections.abc import Iterable

    from liftcore.evaluate import CheckReport


def add_arguments(parser: common.Parser) -> None:
    """Add the options of the command."""
    from liftcore import Query

    common.add_lift(parser)
    parser.add_argument("labels", type=Path, help="masks of phrases, of 'splatlift pack prompts'")
    common.add_encoder(parser)
    common.add_fields(parser, Query, ("threshold", "negatives"), FIELD_OVERRIDES)


def run(options: argparse.Namespace) -> int:
    """Evaluate the lift, and print the figures."""
    from liftcore.evaluate import evaluate_lift

    names = {"labels": "LABELS", "negatives": "--negative", "give encoder=": "--table FILE or --encoder NAME"}
    with common.option_errors(names):
        evaluation = evaluate_lift(
            common.open_lift(options),
            options.labels,
            encoder=common.encoder_spec(options),
            threshold=options.threshold,
            negatives=options.negatives,
            progress=True,
        )
    reply(evaluation.document(), as_json=options.json, lines=evaluation.lines())
    return 0


def add_arguments_inspect(parser: common.Parser) -> None:
    """Add the options of the command ``inspect``."""
    parser.add_argument("file", type=Path, help="splats, cameras, features, a lift, masks or a text table")


def run_inspect(options: argparse.Namespace) -> int:
    """Describe a file of any kind."""
    from liftcore.evaluate import inspect_file

    document = {"file": str(options.file), **inspect_file(options.file)}
    unnamed = {name: "not named" for name in ("encoder", "text_space") if document.get(name) == ""}
    reply(document if options.json else document | unnamed, as_json=options.json)
    return 0


def add_arguments_check(parser: common.Parser) -> None:
    """Add the options of the command ``check``."""
    parser.add_argument("splats", type=Path, help="trained splats")
    parser.add_argument("cameras", type=Path, help="COLMAP, transforms.json or cameras.json")
    parser.add_argument("others", type=Path, nargs="*", help="folders of photos, and feature packs")
    parser.add_argument("--worst", type=Path, metavar="PNG", help="write the worst view and its photo")
    common.add_set(parser)
    common.add_verbose(parser)


def run_check(options: argparse.Namespace) -> int:
    """Check the scene, and print the problems; the exit status is 2 if there are any."""
    from liftcore import LiftSettings
    from liftcore.evaluate import check_scene

    settings = LiftSettings.of(**pairs_of(options.set))
    files = outputs_of(options)
    check_outputs(files, options)
    packs = [path for path in options.others if path.suffix == ".safetensors"]
    photos = [path for path in options.others if path not in packs]
    begin = time.perf_counter()
    report = check_scene(options.splats, options.cameras, photos, packs or None, True, settings)
    document = {name: value for name, value in asdict(report).items() if name != "worst"}
    document |= {"healthy": not report.wrong, "seconds": time.perf_counter() - begin}
    if (picture := report.worst) is not None:
        document |= write_files(files, {"worst": lambda path: path.write_bytes(picture)})
    reply(document, as_json=options.json, lines=_check_lines(report, document, options.verbose))
    return common.BAD_INPUT if report.wrong else 0


def _check_lines(report: CheckReport, document: dict, verbose: bool) -> Iterable[str]:
    if verbose:
        for view in report.views:
            photo_match = "" if view.psnr is None else f", {view.psnr:.1f} dB to its photo"
            other_match = "" if view.other_psnr is None else f" and {view.other_psnr:.1f} to others"
            yield f"  {view.view}: row sums {view.row_sum:.3f}{photo_match}{other_match}"
        yield f"  {report.in_view:.1%} of the splats are in some view"
        yield from (f"  features, {name.replace('_', ' ')}: {value:.3f}" for name, value in report.features.items())
    photo_views = [view for view in report.views if view.psnr is not None]
    if photo_views:
        worst = min(photo_views, key=lambda view: view.psnr or 0.0)
        typical = median(view.psnr for view in photo_views if view.psnr is not None)
        yield f"renders are {typical:.1f} dB from their photos in the median, {worst.psnr:.1f} in {worst.view}"
    yield from (f"note: {text}" for text in report.notes)
    yield from (f"wrong: {text}" for text in report.wrong)
    if "worst" in document:
        yield f"  worst: {document['worst']}"
    if report.wrong:
        yield "not healthy: fix the problems before you lift"
    else:
        yield f"healthy: no contradictions between the inputs ({document['seconds']:.0f} s); next: splatlift lift"


def add_arguments_tradeoff(parser: common.Parser) -> None:
    """Add the options of the command ``tradeoff``."""
    common.add_sources(parser)
    parser.add_argument("--budget", type=_seconds, default=600.0, metavar="SECONDS", help="time limit; default 600")
    parser.add_argument("-o", "--out", type=Path, default=Path("tradeoff"), metavar="DIR", help="of the output")
    common.add_set(parser)
    parser.add_argument("--labels", type=Path, metavar="MASKS", help="VIEW/mask [h, w], class numbers")
    parser.add_argument("--table", type=Path, metavar="FILE", help="text embeddings of the classes")
    parser.add_argument("--classes", nargs="+", default=[], metavar="WORD", help="the classes, from 0 on")
    common.add_threads(parser)


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected seconds, got {text!r}")
    return value


def run_tradeoff(options: argparse.Namespace) -> int:
    """Compare, write the chart, the table and the JSON, and print the recommendation."""
    settings = pairs_of(options.set)
    from liftcore.evaluate import SceneFiles, compare_speeds
    from liftcore.files import writing

    check_outputs({"output": options.out / "tradeoff.json"}, options, kind="json")
    sources = options.splats, options.cameras, tuple(options.features)
    with common.option_errors({"settings": "--set"}):
        comparison = compare_speeds(
            SceneFiles(*sources, options.labels, options.table, tuple(options.classes)),
            budget=options.budget,
            settings=settings,
            threads=options.threads,
            progress=True,
            scene=options.splats.resolve().parent.name,
            command=options.command_line,
        )
    with writing(options.out):
        files = comparison.save(options.out)
    document = comparison.document | {"files": [str(file) for file in files]}
    reply(document, as_json=options.json, lines=[*comparison.lines(), "", *document["files"]])
    return 0
