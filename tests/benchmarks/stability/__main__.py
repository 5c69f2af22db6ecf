"""``python -m tests.benchmarks.stability docs/stability.md``: measure every extreme and write the page."""

from __future__ import annotations

import argparse
from pathlib import Path

from liftcore.io.files import whole_file
from liftcore.raster.cpu.warm_up import warm_up
from liftcore.scene.splats import Kernel
from tests.benchmarks.stability.page import page


def main() -> None:
    """Write the page whole or not at all."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.stability", description=__doc__)
    parser.add_argument("page", type=Path, metavar="FILE", help="the Markdown to write")
    out = parser.parse_args().page
    for kernel in Kernel:
        warm_up(kernel)
    with whole_file(out) as handle:
        handle.write(page().encode())


if __name__ == "__main__":
    main()
