"""``splatlift evaluate``: lifts against the labels of LeRF-OVS and 3D-OVS, in the protocols of the field."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.cli.options import Parser, add_encoder, text_encoder
from liftcore.cli.reply import reply
from liftcore.errors import InvalidInput
from liftcore.io.files import visible_files
from liftcore.runtime.progress import progress_bars

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    from liftcore.evaluate.judging import EvaluationSettings, SceneResult
    from liftcore.evaluate.labels import LabelledScene
    from liftcore.evaluate.protocols import EvaluationProtocol
    from liftcore.evaluate.published import Published

_LIFT_SUFFIX = ".safetensors"
_IOUS = {"object_micro": "mIoU, objects", "frame_macro": "mIoU, frames", "class_pooled": "IoU, classes"}
_SHOWN = {  # the means of a protocol that a table shows, and their names there
    "P1": _IOUS | {"localised": "mAcc, in a box"},
    "P2": _IOUS | {"accuracy_25": "mAcc@0.25", "accuracy_50": "mAcc@0.5"},
    "P3": _IOUS | {"localised": "mAcc, in the mask"},
    "own": _IOUS | {"accuracy_25": "mAcc@0.25", "accuracy_50": "mAcc@0.5"},
}


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    from liftcore.query.question import METHODS

    parser.add_argument("dataset", choices=("lerf-ovs", "3d-ovs"), help="whose labels")
    parser.add_argument(
        "lifts", nargs="+", metavar="LIFT", help="SCENE=LIFT, SCENE.lift.safetensors, or a folder of those"
    )
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="the dataset, or its labels")
    add_encoder(parser)
    parser.add_argument("--protocol", nargs="+", choices=("P1", "P2", "P3", "own"), help="else all")
    parser.add_argument(
        "--threshold", default="auto", metavar="T", help=f"of P2, P3 and own: {', '.join(METHODS)} or a number"
    )
    competitors = "texts to compete with: all up to the next option; may be given several times"
    parser.add_argument("--negative", nargs="+", action="extend", default=[], metavar="WORD", help=competitors)
    parser.add_argument("--held-out", type=Path, metavar="FILE", help="the only frames to judge, a name a line")


def run(options: argparse.Namespace) -> int:
    """Judge every lift whose scene is labelled, and print what was measured beside what was published."""
    from liftcore.evaluate.judging import evaluate_scene
    from liftcore.evaluate.published import published
    from liftcore.query.scene import Scene

    scenes = _labelled(options.dataset, options.data)
    lifts = find_lifts(options.lifts, scenes)
    settings = _settings(options)
    results: list[SceneResult] = []
    warnings: list[str] = []
    with progress_bars() as progress:
        for name, path in lifts.items():
            scene = Scene(path)
            encoder = text_encoder(options, scene)
            found, said = evaluate_scene(scenes[name], scene, encoder, settings, progress)
            results += found
            warnings += said
    rows = published(options.dataset, lifts)
    document = _document(options, lifts, settings, results, rows) | {"warnings": warnings}
    lines = [*_table(results, rows), *(f"warning: {text}" for text in warnings)]
    reply(document, as_json=options.json, lines=lines)
    return 0


def find_lifts(given: Sequence[str], scenes: Collection[str]) -> dict[str, Path]:
    """Scene -> its lift, of ``SCENE=LIFT``, of files named after their scenes, and of folders of those.

    Raises:
        InvalidInput: a lift belongs to no labelled scene, or two belong to one.
    """
    found: dict[str, Path] = {}
    for text in given:
        scene, equals, rest = text.partition("=")
        path = Path(rest if equals and scene in scenes else text)
        pairs = [(scene, path)] if equals and scene in scenes else _named_lifts(path, scenes)
        for name, lift in pairs:
            if name in found:
                raise InvalidInput("lifts", expected="one lift a scene", got=f"{found[name]} and {lift} of {name}")
            found[name] = lift
    return found


def _named_lifts(path: Path, scenes: Collection[str]) -> list[tuple[str, Path]]:
    files = visible_files(path, f"*{_LIFT_SUFFIX}") if path.is_dir() else [path]
    named = [(file.name.partition(".")[0], file) for file in files]
    pairs = [(name, file) for name, file in named if name in scenes]
    if not pairs and len(scenes) == 1 and path.is_file():
        return [(next(iter(scenes)), path)]
    if not pairs:
        raise InvalidInput(
            "lifts",
            expected=f"SCENE{_LIFT_SUFFIX} of a labelled scene ({', '.join(sorted(scenes)[:6])})",
            got=str(path) if path.exists() else f"nothing at {path}",
            hint="SCENE=LIFT says which scene a lift is of",
        )
    return pairs


def _labelled(dataset: str, data: Path) -> Mapping[str, LabelledScene]:
    from liftcore.evaluate.labels import lerf_scenes, three_d_ovs_scenes

    return lerf_scenes(data) if dataset == "lerf-ovs" else three_d_ovs_scenes(data)


def _settings(options: argparse.Namespace) -> EvaluationSettings:
    from liftcore.evaluate.judging import EvaluationSettings
    from liftcore.evaluate.protocols import EvaluationProtocol

    try:
        threshold = float(options.threshold)
    except ValueError:
        threshold = options.threshold
    chosen = dict.fromkeys(options.protocol) if options.protocol else EvaluationProtocol
    held_out = _names(options.held_out) if options.held_out else None
    protocols = tuple(EvaluationProtocol(name) for name in chosen)
    return EvaluationSettings(protocols, threshold, tuple(options.negative), held_out)


def _names(path: Path) -> frozenset[str]:
    """View names, one a line, with or without an image's extension."""
    from liftcore.scene.views import view_names

    try:
        lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInput("--held-out", expected="a file of view names, one a line", got=str(error)) from None
    names = frozenset(view_names([line])[0] for line in lines if line)
    if not names:
        raise InvalidInput("--held-out", expected="a file of view names, one a line", got=f"none in {path}")
    return names


def _document(
    options: argparse.Namespace,
    lifts: Mapping[str, Path],
    settings: EvaluationSettings,
    results: Sequence[SceneResult],
    rows: Sequence[Published],
) -> dict[str, Any]:
    from liftcore.evaluate.judging import mean_over_scenes

    return {
        "dataset": options.dataset,
        "settings": {
            "protocols": list(settings.protocols),
            "threshold": settings.threshold,
            "negatives": list(settings.negatives),
            "held_out": sorted(settings.held_out) if settings.held_out is not None else None,
        },
        "measured": [
            {
                "scene": result.scene,
                "protocol": result.protocol,
                "lift": str(lifts[result.scene]),
                "frames": result.frames,
                "lifted_frames": result.lifted,
                "means": {group: asdict(values) for group, values in result.means().items()},
                "classes": result.classes(),
                "objects": [{**asdict(row), "iou": row.iou} for row in result.rows],
            }
            for result in results
        ],
        "mean_of_scenes": {
            protocol: {group: asdict(values) for group, values in groups.items()}
            for protocol, groups in mean_over_scenes(results).items()
        },
        "published": [asdict(row) for row in rows],
    }


def _table(results: Sequence[SceneResult], rows: Sequence[Published]) -> Iterable[str]:
    """Percentages: what was measured, a protocol and a metric a row; then what was published."""
    from liftcore.evaluate.judging import mean_over_scenes

    scenes = tuple(dict.fromkeys(result.scene for result in results))
    head = ("", "protocol", "metric", "frames", *scenes, "mean", "method", "source")
    lines: list[tuple[str, ...]] = [head]
    for protocol, groups in mean_over_scenes(results).items():
        by_scene = {result.scene: result.means() for result in results if result.protocol == protocol}
        for group, overall in groups.items():
            for key, label in _SHOWN[protocol].items():
                if getattr(overall, key) is None:
                    continue
                cells = [_percent(getattr(by_scene[name][group], key)) if name in by_scene else "" for name in scenes]
                mean = _percent(getattr(overall, key))
                about = _lifted(results, protocol, group)
                lines.append(("measured", protocol, label, group, *cells, mean, "this lift", about))
    for row in rows:
        cells = [f"{row.scenes[name]:.1f}" if name in row.scenes else "" for name in scenes]
        mean = f"{row.mean:.1f}" if row.scenes.keys() <= set(scenes) else ""  # over the paper's scenes
        known = row.protocol if row.protocol in _SHOWN else "unknown"
        source = f"{row.source}, {row.note}" if row.note else row.source
        lines.append(("published", known, row.metric, "", *cells, mean, row.method, source))
    widths = [max(len(line[k]) for line in lines) for k in range(len(head))]
    for line in lines:
        yield "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f}"


def _lifted(results: Sequence[SceneResult], protocol: EvaluationProtocol, group: str) -> str:
    from liftcore.evaluate.judging import ALL

    count = sum(len(result.lifted) for result in results if result.protocol == protocol)
    total = sum(len(result.frames) for result in results if result.protocol == protocol)
    return f"{count} of {total} frames were lifted" if group == ALL and count else ""
