"""``splatlift lift``: features on splats, from three kinds of files to one."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from liftcore.commands.bars import progress_bars
from liftcore.commands.reply import free_output, reply, shown, writing
from liftcore.errors import InvalidSettings
from liftcore.solve.settings import LiftSettings

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterable, Sequence

    from liftcore.artifact import Lift


def run(options: argparse.Namespace) -> int:
    """Lift, write the lift whole or not at all, and say what came of it."""
    settings = settings_of(options.preset, options.set)
    from liftcore.artifact import save_lift
    from liftcore.lift import lift
    from liftcore.scene.load import camera_files

    views = camera_files(options.cameras) if options.cameras.is_dir() else [options.cameras]
    out = free_output(options.output, [options.splats, *views, *options.features])

    with progress_bars() as progress:
        result = lift(
            options.splats,
            options.cameras,
            options.features,
            settings,
            threads=options.threads,
            progress=progress,
        )
    with writing(out):
        save_lift(result, out)
    document = {"out": str(out), **_summary(result), "warnings": _warnings(result)}
    reply(document, as_json=options.json, lines=_lines(document))
    return 0


def settings_of(preset: str | None, pairs: Sequence[str]) -> LiftSettings:
    """Settings of ``--preset`` and ``--set key=value``; a value is JSON, or else a word.

    Raises:
        InvalidSettings: a pair without ``=``, an unknown name or a value out of range.
    """
    values: dict[str, Any] = {} if preset is None else {"preset": preset}
    for pair in pairs:
        key, equals, text = pair.partition("=")
        if not equals or not key:
            raise InvalidSettings("--set", expected="key=value", got=repr(pair))
        try:
            values[key] = json.loads(text)
        except (ValueError, RecursionError):
            values[key] = text
    return LiftSettings.of(**values)


def _summary(result: Lift) -> dict[str, Any]:
    metadata = result.metadata
    return {
        "splats": result.features.shape[0],
        "seen_share": float(result.seen.float().mean()),
        "channels": result.features.shape[1],
        "views": len(metadata.views),
        "encoder": metadata.encoder,
        "text_space": metadata.text_space,
        "certificate": metadata.certificate,
        "timings": metadata.timings,
        "settings": metadata.settings.model_dump(mode="json"),
    }


def _warnings(result: Lift) -> list[str]:
    skipped = result.metadata.certificate.get("views_without_camera", [])
    warnings = []
    if skipped:
        some = ", ".join(skipped[:3])
        warnings.append(f"{len(skipped)} views have features but no camera and were skipped: {some}")
    if not bool(result.seen.any()):
        warnings.append("no labelled ray reached any splat: check that splats and cameras share their frame")
    return warnings


def _lines(document: dict[str, Any]) -> Iterable[str]:
    yield (
        f"{document['out']}: {document['splats']} splats x {document['channels']} channels "
        f"from {document['views']} views, {document['seen_share']:.1%} of the splats seen"
    )
    for part in ("certificate", "timings"):
        for key, value in document[part].items():
            yield f"  {key}: {shown(value)}"
    yield from (f"warning: {warning}" for warning in document["warnings"])
