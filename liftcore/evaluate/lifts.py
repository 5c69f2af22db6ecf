"""Evaluation of lifts by the labels of LeRF-OVS and 3D-OVS, beside those of papers."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from liftcore.errors import InvalidInput
from liftcore.evaluate.judging import ALL, EvaluationSettings, SceneResult, evaluate_scene, mean_over_scenes
from liftcore.evaluate.labels import lerf_scenes, three_d_ovs_scenes
from liftcore.evaluate.protocols import EvaluationProtocol
from liftcore.evaluate.published import Published, published
from liftcore.io.files import visible_files
from liftcore.query.scene import Scene
from liftcore.runtime.arguments import as_list, as_path, check_choice
from liftcore.runtime.progress import Progress, shown_progress
from liftcore.scene.views import view_names
from liftcore.text import TextEncoder

_DATASETS = {"lerf-ovs": lerf_scenes, "3d-ovs": three_d_ovs_scenes}
_LIFT_SUFFIX = ".safetensors"
_IOUS = {"object_micro": "mIoU, objects", "frame_macro": "mIoU, frames", "class_pooled": "IoU, classes"}
_COLUMNS = {  # the means of a protocol that a table shows, and their names there
    "P1": _IOUS | {"localised": "mAcc, in a box"},
    "P2": _IOUS | {"accuracy_25": "mAcc@0.25", "accuracy_50": "mAcc@0.5"},
    "P3": _IOUS | {"localised": "mAcc, in the mask"},
    "own": _IOUS | {"accuracy_25": "mAcc@0.25", "accuracy_50": "mAcc@0.5"},
}


@dataclass(frozen=True)
class Evaluation:
    """The results of lifts by scene and protocol."""

    dataset: str
    lifts: Mapping[str, Path]  # by scene
    settings: EvaluationSettings
    results: tuple[SceneResult, ...]
    published: tuple[Published, ...]  # rows of papers, of these scenes
    warnings: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """Return all figures, ready for JSON."""
        return {
            "dataset": self.dataset,
            "settings": {
                "protocols": list(self.settings.protocols),
                "threshold": self.settings.threshold,
                "negatives": list(self.settings.negatives),
                "held_out": sorted(self.settings.held_out) if self.settings.held_out is not None else None,
            },
            "measured": [
                {
                    "scene": result.scene,
                    "protocol": result.protocol,
                    "lift": str(self.lifts[result.scene]),
                    "frames": result.frames,
                    "lifted_frames": result.lifted,
                    "means": {group: asdict(values) for group, values in result.means().items()},
                    "classes": result.classes(),
                    "objects": [{**asdict(row), "iou": row.iou} for row in result.rows],
                }
                for result in self.results
            ],
            "mean_of_scenes": {
                protocol: {group: asdict(values) for group, values in groups.items()}
                for protocol, groups in mean_over_scenes(self.results).items()
            },
            "published": [asdict(row) for row in self.published],
            "warnings": list(self.warnings),
        }

    def lines(self) -> Iterable[str]:
        """Yield a table of percentages, a protocol and a metric a row: measured, then published."""
        yield from _table(self.results, self.published)
        yield from (f"warning: {text}" for text in self.warnings)


def evaluate_lifts(
    dataset: Literal["lerf-ovs", "3d-ovs"],
    lifts: Path | str | Sequence[Path | str],
    data: Path | str,
    *,
    encoder: TextEncoder | str | None = None,
    protocols: str | Sequence[str] = tuple(EvaluationProtocol),
    threshold: str | float = "auto",
    negatives: str | Sequence[str] = (),
    held_out: Path | str | None = None,
    progress: Progress | bool | None = None,
) -> Evaluation:
    """Evaluate every lift whose scene is labelled.

    Args:
        dataset: whose labels. lifts: SCENE=LIFT, SCENE.lift.safetensors, or folders of those. data: the dataset, or
            its labels.
        encoder: of the categories, or its specification; None: that of each lift's text space.
        protocols: P1, P2, P3 and own, or some. threshold: of all but P1, a method or a number. negatives: texts to
            compete with.
        held_out: a file of the only frames to evaluate, a name a line; None: all labelled ones.
        progress: as in `liftcore.lift`.

    Raises:
        InvalidInput: a lift belongs to no labelled scene, or two to one; the dataset or protocol is unknown; or as in
            `evaluate_scene`.
        InvalidQuery, InvalidLift, Unavailable: as in `evaluate_scene` and `Scene.encoder`.
    """
    check_choice("dataset", dataset, _DATASETS)
    labels = _DATASETS[dataset](as_path(data, "data"))
    files = find_lifts(as_list(lifts), labels)
    names = _names(as_path(held_out, "held_out")) if held_out else None
    for name in as_list(protocols) or [None]:
        check_choice("protocols", name, EvaluationProtocol)
    ways = tuple(EvaluationProtocol(name) for name in dict.fromkeys(as_list(protocols)))
    settings = EvaluationSettings(ways, threshold, tuple(as_list(negatives)), names)
    results: list[SceneResult] = []
    warnings: list[str] = []
    with shown_progress(progress) as reporter:
        for name, path in files.items():
            scene = Scene(path)
            reader = scene.encoder(encoder, hint="give encoder=", stand_in=False)
            scene_results, notes = evaluate_scene(labels[name], scene, reader, settings, reporter)
            results += scene_results
            warnings += notes
    rows = published(dataset, files)
    return Evaluation(dataset, files, settings, tuple(results), tuple(rows), tuple(warnings))


def find_lifts(lifts: Iterable[Path | str], scenes: Collection[str]) -> dict[str, Path]:
    """Find the lift of each scene, from ``SCENE=LIFT``, files named after their scenes, and folders of those.

    Raises:
        InvalidInput: a lift belongs to no labelled scene, or two belong to one.
    """
    by_scene: dict[str, Path] = {}
    for lift in lifts:
        as_path(lift, "lifts")
        text = str(lift)
        scene, equals, rest = text.partition("=")
        path = Path(rest if equals and scene in scenes else text)
        pairs = [(scene, path)] if equals and scene in scenes else _named_lifts(path, scenes)
        for name, file in pairs:
            if name in by_scene:
                raise InvalidInput("lifts", expected="one lift a scene", got=f"{by_scene[name]} and {file} of {name}")
            by_scene[name] = file
    return by_scene


def _named_lifts(path: Path, scenes: Collection[str]) -> list[tuple[str, Path]]:
    files = visible_files(path, f"*{_LIFT_SUFFIX}") if path.is_dir() else [path]
    pairs = [(name, file) for file in files if (name := file.name.partition(".")[0]) in scenes]
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


def _names(path: Path) -> frozenset[str]:
    """Read view names, one a line, with or without an image's extension."""

    try:
        lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInput("held_out", expected="a file of view names, one a line", got=str(error)) from None
    names = frozenset(view_names([line])[0] for line in lines if line)
    if not names:
        raise InvalidInput("held_out", expected="a file of view names, one a line", got=f"none in {path}")
    return names


def _table(results: Sequence[SceneResult], rows: Sequence[Published]) -> Iterable[str]:
    """Yield a table of percentages, a protocol and a metric a row: measured, then published."""

    scenes = tuple(dict.fromkeys(result.scene for result in results))
    head = ("", "protocol", "metric", "frames", *scenes, "mean", "method", "source")
    lines: list[tuple[str, ...]] = [head]
    for protocol, groups in mean_over_scenes(results).items():
        by_scene = {result.scene: result.means() for result in results if result.protocol == protocol}
        for group, overall in groups.items():
            for key, label in _COLUMNS[protocol].items():
                if getattr(overall, key) is None:
                    continue
                cells = [_percent(getattr(by_scene[name][group], key)) if name in by_scene else "" for name in scenes]
                mean = _percent(getattr(overall, key))
                about = _lifted(results, protocol, group)
                lines.append(("measured", protocol, label, group, *cells, mean, "this lift", about))
    for row in rows:
        cells = [f"{row.scenes[name]:.1f}" if name in row.scenes else "" for name in scenes]
        mean = f"{row.mean:.1f}" if row.scenes.keys() <= set(scenes) else ""  # over the paper's scenes
        protocol = row.protocol if row.protocol in _COLUMNS else "unknown"
        source = f"{row.source}, {row.note}" if row.note else row.source
        lines.append(("published", protocol, row.metric, "", *cells, mean, row.method, source))
    widths = [max(len(line[k]) for line in lines) for k in range(len(head))]
    for line in lines:
        yield "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f}"


def _lifted(results: Sequence[SceneResult], protocol: EvaluationProtocol, group: str) -> str:

    count = sum(len(result.lifted) for result in results if result.protocol == protocol)
    total = sum(len(result.frames) for result in results if result.protocol == protocol)
    return f"{count} of {total} frames were lifted" if group == ALL and count else ""
