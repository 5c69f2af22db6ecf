"""``splatlift bench``: how fast this machine lifts."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from liftcore.commands.reply import reply
from liftcore.errors import InvalidInput

if TYPE_CHECKING:
    import argparse

_OPTIONS = ("scene", "splats", "size", "channels", "levels", "views", "threads")


def run(options: argparse.Namespace) -> int:
    """Measure, and print the figures with the hardware they were taken on."""
    values: dict[str, Any] = {name: getattr(options, name) for name in _OPTIONS}
    if options.size is not None:
        values["size"] = image_size(options.size)
    from liftcore.measure.bench import run_bench

    reply(run_bench(values), as_json=options.json)
    return 0


def image_size(text: str) -> tuple[int, int]:
    """Width and height of ``WxH``.

    Raises:
        InvalidInput: the text is not of that form.
    """
    match = re.fullmatch(r"([1-9][0-9]{0,4})x([1-9][0-9]{0,4})", text)
    if match is None:
        raise InvalidInput("--size", expected="WxH in pixels, such as 986x728", got=repr(text))
    return int(match[1]), int(match[2])
