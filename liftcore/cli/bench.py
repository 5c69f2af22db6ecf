"""``splatlift bench``: how fast this machine lifts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from liftcore.cli.reply import reply

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterator

_OPTIONS = ("scene", "splats", "size", "channels", "levels", "views", "threads", "preset", "stages", "aims", "device")


def run(options: argparse.Namespace) -> int:
    """Measure, and print the figures with the hardware they were taken on."""
    from liftcore.evaluate.bench import run_bench

    document = run_bench({name: getattr(options, name) for name in _OPTIONS})
    lines = _steps(document) if options.stages else _aims(document) if options.aims else None
    reply(document, as_json=options.json, lines=lines)
    return 0


def _aims(document: dict[str, Any]) -> Iterator[str]:
    """The aims and what was found, for people."""
    from liftcore.evaluate.aims import lines_of

    yield _told(document)
    for preset, found in document["presets"].items():
        yield f"{preset}, load {found['load']:.1f}:"
        yield from (f"  {line}" for line in lines_of(found))


def _told(document: dict[str, Any]) -> str:
    """What was measured, and on what, in a line."""
    rest = {key: value for key, value in document.items() if key not in ("presets", "hardware")}
    return ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in (rest | document["hardware"]).items())


def _steps(document: dict[str, Any]) -> Iterator[str]:
    """The steps of a view as a table for people."""
    yield _told(document)
    for preset, found in document["presets"].items():
        yield f"{preset}: seconds a view on one thread, median (smallest); load {found['load']:.1f}"
        for name, figures in found["stages"].items():
            wall, cpu = (f"{figures[key]:.4f} ({figures[f'{key}_min']:.4f})" for key in ("wall_s", "cpu_s"))
            yield f"  {name:<10}  wall {wall}  processor {cpu}"
