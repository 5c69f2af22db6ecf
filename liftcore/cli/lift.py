"""``splatlift lift``, ``plan`` and ``transfer``: lift features, plan that, or take a lift to other splats."""

from __future__ import annotations

import argparse
import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli.options import (
    Parser,
    add_settings,
    add_sources,
    add_splats,
    add_verbose,
    add_world,
    option_errors,
    world_of,
)
from liftcore.cli.reply import check_outputs, reply, short_text, smoothing_line, write_files
from liftcore.errors import InvalidInput, InvalidSettings

FEW_VIEWS = 26  # of masks, where smoothing improves features; with 52 it hardly does (docs/results.md)
CLOSED_SCENE_ROW_SUM = 0.9  # least mean row sum of a scene that was trained with its background
NUMBERS = (12, 16)  # of a matrix

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from liftcore import LiftResult, LiftSettings, Plan


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    add_sources(parser)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="LIFT", help="the lift to write")
    add_settings(parser)
    add_world(parser)
    add_verbose(parser)
    parser.add_argument("--checkpoint", type=Path, metavar="DIR", help="keep rasterized views, to resume")
    parser.add_argument("--engine", metavar="NAME", help="lift in blocks of bounded memory: local or ray")
    parser.add_argument("--address", metavar="HOST:PORT", help="of the Ray cluster, or auto")


def add_arguments_plan(parser: Parser) -> None:
    """Add the options of the command ``plan``."""
    add_sources(parser)
    add_settings(parser)


def run(options: argparse.Namespace) -> int:
    """Lift, write the lift completely or not at all, and print a summary."""
    settings, world = settings_of(options), world_of(options)
    from liftcore import lift_files, open_engine
    from liftcore.files import check_output

    files = {"output": options.output}
    check_outputs(files, options, kind="lift")
    engine = open_engine(options.engine, options.address, options.threads)
    if options.checkpoint:
        with option_errors({"output": "checkpoint"}):
            check_output(options.checkpoint / "checkpoint.json", (), "json")

    plans: list[Plan] = []

    def add_plan(plan: Plan) -> None:
        plans.append(plan)
        if not options.json:
            print(*plan_lines(plan), sep="\n", flush=True)

    result = lift_files(
        options.splats,
        options.cameras,
        options.features,
        settings,
        threads=options.threads,
        progress=True,
        on_plan=add_plan,
        checkpoint=options.checkpoint or None,
        engine=engine,
    ).with_world(world)
    write_files(files, {"output": partial(result.save, progress=True)})
    (plan,) = plans
    warnings = result.metadata.diagnostics["warnings"]
    document = {"out": str(options.output), **_summary(result), "warnings": [*plan.machine_warnings, *warnings]}
    new_warnings = [warning for warning in warnings if warning not in plan.input_warnings]  # the plan printed others
    lines = _lines(document | {"warnings": new_warnings}, options.verbose)
    reply(document, as_json=options.json, lines=lines)
    return 0


def run_plan(options: argparse.Namespace) -> int:
    """Print the plan of a lift."""
    from liftcore import plan_files

    settings = settings_of(options)
    plan = plan_files(options.splats, options.cameras, options.features, settings, threads=options.threads)
    document = {
        **plan.facts(),
        "device": {"kind": plan.device.kind, "name": plan.device.name},
        "views": {"lifted": list(plan.views), "left_out": list(plan.left_out)},
        "warnings": list(plan.warnings),
    }
    reply(document, as_json=options.json, lines=plan_lines(plan))
    return 0


def settings_of(options: argparse.Namespace) -> LiftSettings:
    """Return the settings of ``--preset``, ``--quality``, ``--device`` and ``--set key=value``."""
    from liftcore import LiftSettings

    options_by_name = {"preset": options.preset, "quality": options.quality, "device": options.device}
    values = pairs_of(options.set)
    for name, value in options_by_name.items():
        if value is not None and values.setdefault(name, value) != value:
            raise _contradiction(name, f"--{name} {value}", f"--set {name}={values[name]}")
    return LiftSettings.of(**values)


def pairs_of(pairs: Sequence[str]) -> dict[str, Any]:
    """Parse names and values of ``key=value``; a value is JSON, or else a text."""
    values: dict[str, Any] = {}
    for pair in pairs:
        key, equals, text = pair.partition("=")
        if not equals or not key:
            raise InvalidSettings("--set", expected="key=value", got=repr(pair))
        value = _value(text)
        if key in values and values[key] != value:
            raise _contradiction(key, f"--set {key}={values[key]}", f"--set {pair}")
        values[key] = value
    return values


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


def _contradiction(name: str, first: str, second: str) -> InvalidSettings:
    hint = "remove one of them"
    return InvalidSettings(name, expected="one value", got=f"{first} and {second}"[:200], hint=hint)


def plan_lines(plan: Plan) -> Iterable[str]:
    """Yield the plan in a few lines, with its verdict."""
    head, *rest = plan.summary()
    yield f"plan: {head}"
    yield from (f"  {line}" for line in rest)
    yield from (f"warning: {warning}" for warning in plan.warnings)
    if not plan.warnings:
        yield "  healthy: no contradictions between the inputs"


def _summary(result: LiftResult) -> dict[str, Any]:
    metadata = result.metadata
    return {
        "splats": len(result),
        "feature_share": float(result.has_feature.float().mean()),
        "channels": result.rows.shape[1],
        "views": len(metadata.views),
        "lifted": list(metadata.views),
        "encoder": metadata.encoder,
        "text_space": metadata.text_space,
        "world": metadata.world.model_dump(mode="json"),
        "diagnostics": result.diagnostics,
        "timings": metadata.timings,
        "settings": metadata.settings.model_dump(mode="json"),
    }


def _lines(document: dict[str, Any], verbose: bool) -> Iterable[str]:
    yield (
        f"{document['out']}: {document['splats']} splats x {document['channels']} channels "
        f"from {document['views']} views, {document['feature_share']:.1%} of the splats have a feature, "
        f"in {sum(document['timings'].values()):.1f} s"
    )
    yield from (f"warning: {warning}" for warning in document["warnings"])
    yield from _verdict(document)
    if not verbose:
        return
    for key, value in document["diagnostics"].items():
        if key not in ("plan", "warnings"):  # the plan is printed before the lift
            yield f"  {key}: {smoothing_line(value) if key == 'smoothing' else short_text(value)}"
    yield "timings:"
    yield from (f"  {stage}: {seconds:.3f} s" for stage, seconds in document["timings"].items())


def _verdict(document: dict[str, Any]) -> Iterable[str]:
    """Yield the verdict: coverage of rays, smoothing, warnings, and the next command."""
    from liftcore.text import NO_WORDS

    diagnostics = document["diagnostics"]
    row_sum = diagnostics["row_sum_mean"]
    if row_sum is not None:
        note = "as in a scene without holes" if row_sum >= CLOSED_SCENE_ROW_SUM else "so parts of rays hit no splat"
        yield f"splats fill {row_sum:.1%} of a ray on average, {note}"
    masks = diagnostics.get("reweighting", {}).get("masks")
    if masks is not None and not document["settings"]["smoothness"] and (not masks or document["views"] <= FEW_VIEWS):
        of = f"{document['views']} views of masks" if masks else "maps without masks"
        yield f"for {of}: --set smoothness=4 draws neighbours together, and splatlift tradeoff tells whether it helps"
    if diagnostics["warnings"]:
        yield "see the warnings: splatlift check tests whether photos, cameras and splats match"
    space = document["text_space"]
    if not space:
        yield "the packs have no text space: set it with splatlift pack retag, or query with --table FILE"
    example = "WORD" if space not in ("", NO_WORDS) else f"--like {document['lifted'][0]}:X,Y"
    yield f"next: splatlift query {document['out']} {example}  (--verbose shows all figures)"


def add_arguments_transfer(parser: Parser) -> None:
    """Add the options of the command ``transfer``."""
    parser.add_argument("lift", type=Path, help="a lift (.safetensors)")
    parser.add_argument("edited", type=Path, help="other splats of its scene, of any format")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="NEW", help="the lift to write")
    matrix_help = "transform of the scene, a text file of 3 or 4 rows of 4 numbers; default: none"
    parser.add_argument("--matrix", type=Path, metavar="FILE", help=matrix_help)
    add_splats(parser)


def run_transfer(options: argparse.Namespace) -> int:
    """Write the lift of the other splats, and print the origin of their features."""
    from liftcore import Scene, load_lift

    files, scene = {"output": options.output}, Scene(options.lift, splats=options.splats)
    check_outputs(files, options, scene, kind="lift")
    matrix = None if options.matrix is None else _matrix(options.matrix)
    result = load_lift(options.lift).transferred(scene.splats, options.edited, matrix=matrix)
    write_files(files, {"output": partial(result.save, progress=True)})
    facts = result.diagnostics["transfer"]
    document: dict[str, Any] = {"out": str(options.output), "splats": len(result), **facts, "warnings": []}
    if unmatched := facts["without_partner"]:
        document["warnings"] = [
            f"{unmatched} of {len(result)} splats are near no splat of the lift, and have no feature"
        ]
    reply(document, as_json=options.json, lines=_transfer_lines(document))
    return 0


def _matrix(path: Path) -> list[list[float]]:
    try:
        numbers = [float(word) for word in path.read_text(encoding="utf-8-sig").replace(",", " ").split()]
    except (OSError, ValueError) as error:
        expected = "a text of 12 or 16 numbers, as numpy.savetxt writes it"
        raise InvalidInput("--matrix", expected=expected, got=str(error)[:120]) from None
    if len(numbers) not in NUMBERS:
        raise InvalidInput("--matrix", expected="a file of 12 or 16 numbers", got=str(len(numbers)))
    return [numbers[first : first + 4] for first in range(0, len(numbers), 4)]


def _transfer_lines(document: dict[str, Any]) -> list[str]:
    lines = [f"{document['out']}: {document['splats']} splats, {document['rows']} of them rows of the lift"]
    return lines + [f"warning: {warning}" for warning in document["warnings"]]
