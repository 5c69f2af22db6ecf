"""``splatlift lift``: features on splats, from three kinds of files to one."""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli.options import Parser, add_settings, add_sources, add_verbose, add_world, count, place, world_of
from liftcore.cli.reply import reply, shown, smoothing_line
from liftcore.errors import InvalidInput, InvalidSettings

FEW_VIEWS = 26  # of masks: smooth features gain there, and hardly with 52 (docs/results.md)
FILLED = 0.9  # of a ray, in a scene that was trained with its background

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from liftcore import LiftResult, LiftSettings, Plan


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    add_sources(parser)
    parser.add_argument("-o", "--output", type=place, required=True, metavar="LIFT", help="the lift to write")
    add_settings(parser)
    add_world(parser)
    parser.add_argument("--explain", action="store_true", help="print the plan before the work")
    add_verbose(parser)
    goes_on = "a killed lift goes on from there, and one of the same regions with other features walks none again"
    parser.add_argument("--checkpoint", type=Path, metavar="DIR", help=f"keep walked views there: {goes_on}")
    parser.add_argument("--threads", type=count, metavar="N", help="else as many as there are cores")
    blocks = "lift in blocks, whose memory is bounded: local, in this process; ray, by the workers of a Ray cluster"
    shards = "X.shards as LIFT is a folder of shards"
    parser.add_argument("--engine", metavar="NAME", help=f"{blocks}; {shards}")
    parser.add_argument("--address", metavar="HOST:PORT", help="of the Ray cluster, or auto; else of this machine")


def run(options: argparse.Namespace) -> int:
    """Lift, write the lift whole or not at all, and say what came of it."""
    settings, world = settings_of(options), world_of(options)
    from liftcore import lift_files, open_engine
    from liftcore.files import check_output, writing

    out = check_output(options.output, [options.splats, options.cameras, *options.features], "lift")
    engine = open_engine(options.engine, options.address, options.threads)
    if options.checkpoint:
        require_folder(options.checkpoint)

    plans: list[Plan] = []

    def take(plan: Plan) -> None:
        plans.append(plan)
        if not options.json:
            print(*(plan.lines() if options.explain else in_short(plan)), sep="\n", flush=True)

    result = lift_files(
        options.splats,
        options.cameras,
        options.features,
        settings,
        threads=options.threads,
        progress=True,
        on_plan=take,
        checkpoint=options.checkpoint or None,
        engine=engine,
    ).with_world(world)
    with writing(out):
        result.save(options.output, progress=True)
    (plan,) = plans
    warnings = result.metadata.certificate["warnings"]
    document = {"out": str(options.output), **_summary(result), "warnings": [*plan.warnings, *warnings]}
    new = [warning for warning in warnings if warning not in plan.told]  # the others were printed with the plan
    reply(
        document, as_json=options.json, lines=_lines(document | {"warnings": new}, options.cameras, options.verbose)
    )
    return 0


def example_in(views: Sequence[str], cameras: Path) -> str:
    """The pixel in the middle of the first of the lifted views, as an example of what to look for."""
    from liftcore import read_cameras

    width, height = read_cameras(cameras, choosing=False, views=views)[views[0]].photo_size
    return f"{views[0]}:{width // 2},{height // 2}"


def require_folder(folder: Path) -> None:
    """See that a checkpoint can be kept in a folder, which is made if need be: a lift itself would go on without one.

    Raises:
        InvalidInput: it is no folder, or nothing can be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        got = f"{folder} ({error.strerror or error})"
        raise InvalidInput("checkpoint", expected="a folder that can be written", got=got) from None


def settings_of(options: argparse.Namespace) -> LiftSettings:
    """Settings of ``--preset``, ``--speed``, ``--device`` and ``--set key=value``.

    Raises:
        InvalidSettings: a pair without ``=``, an unknown name, one with two values or a value out of range.
    """
    from liftcore import LiftSettings

    named = {"preset": options.preset, "speed": options.speed, "device": options.device}
    values = pairs_of(options.set)
    for name, value in named.items():
        if value is not None and values.setdefault(name, value) != value:
            raise _contradiction(name, f"--{name} {value}", f"--set {name}={values[name]}")
    return LiftSettings.of(**values)


def pairs_of(pairs: Sequence[str]) -> dict[str, Any]:
    """Names and values of ``key=value``; a value is JSON, or else a word.

    Raises:
        InvalidSettings: a pair without ``=``, an unknown name or one with two values.
    """
    from liftcore import LiftSettings

    values: dict[str, Any] = {}
    for pair in pairs:
        key, equals, text = pair.partition("=")
        if not equals or not key:
            raise InvalidSettings("--set", expected="key=value", got=repr(pair))
        if key not in LiftSettings.model_fields:
            hint = LiftSettings.hint_of_name(key)
            raise InvalidSettings("--set", expected="a setting of a lift", got=f"the unknown {key[:80]!r}", hint=hint)
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


def _contradiction(name: str, one: str, other: str) -> InvalidSettings:
    hint = "leave one of them out"
    return InvalidSettings(name, expected="one value", got=f"{one} and {other}"[:200], hint=hint)


def in_short(plan: Plan) -> Iterable[str]:
    """The plan in a few lines, with its verdict."""
    head, *rest = plan.summary()
    yield f"plan: {head}"
    yield from (f"  {line}" for line in rest)
    if plan.seconds is not None:
        yield f"  about {max(plan.seconds, 1):.0f} s to look through the views on this machine"
    warnings = (*plan.warnings, *plan.told)
    yield from (f"warning: {warning}" for warning in warnings)
    if not warnings:
        yield "  healthy: nothing contradicts anything that was given"


def _summary(result: LiftResult) -> dict[str, Any]:
    metadata = result.metadata
    return {
        "splats": result.features.shape[0],
        "seen_share": float(result.seen.float().mean()),
        "channels": result.features.shape[1],
        "views": len(metadata.views),
        "lifted": list(metadata.views),
        "encoder": metadata.encoder,
        "text_space": metadata.text_space,
        "world": metadata.world.model_dump(mode="json"),
        "certificate": metadata.certificate,
        "timings": metadata.timings,
        "settings": metadata.settings.model_dump(mode="json"),
    }


def _lines(document: dict[str, Any], cameras: Path, verbose: bool) -> Iterable[str]:
    yield (
        f"{document['out']}: {document['splats']} splats x {document['channels']} channels "
        f"from {document['views']} views, {document['seen_share']:.1%} of the splats seen, "
        f"in {sum(document['timings'].values()):.1f} s"
    )
    yield from (f"warning: {warning}" for warning in document["warnings"])
    yield from _verdict(document, cameras)
    if not verbose:
        return
    for key, value in document["certificate"].items():
        if key not in ("plan", "warnings"):  # the plan in full is what --explain prints
            yield f"  {key}: {smoothing_line(value) if key == 'smoothing' else shown(value)}"
    yield "timings:"
    yield from (f"  {stage}: {seconds:.3f} s" for stage, seconds in document["timings"].items())


def _verdict(document: dict[str, Any], cameras: Path) -> Iterable[str]:
    """What is healthy, what to look at, and what to do."""
    from liftcore.text import NO_WORDS

    certificate = document["certificate"]
    filled = certificate["row_sum_mean"]
    if filled is not None:
        usual = "as of a scene without holes" if filled >= FILLED else "the rest of a ray meets nothing"
        yield f"splats fill {filled:.1%} of a ray, {usual}"
    if "candidates" in certificate.get("smoothing", {}):
        yield smoothing_line(certificate["smoothing"])
    masks = certificate.get("reweighting", {}).get("masks")
    if masks is not None and not document["settings"]["smoothness"] and (not masks or document["views"] <= FEW_VIEWS):
        of = f"{document['views']} views of masks" if masks else "maps without masks"
        yield f"of {of}: --set smoothness=auto would draw neighbours together as far as halves of views gain by it"
    if certificate["warnings"]:
        yield "look at the warnings: splatlift check says whether photos, cameras and splats belong together"
    space = document["text_space"]
    if not space:
        yield "the packs' text space is not named: splatlift pack retag names it, or ask with --table FILE"
    how = "WORD" if space not in ("", NO_WORDS) else f"--like {example_in(document['lifted'], cameras)}"
    yield f"next: splatlift query {document['out']} {how}  (--verbose shows all figures)"
