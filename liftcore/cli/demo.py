"""``splatlift demo``: the whole job on a small scene, through the real service."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import argparse


def run(options: argparse.Namespace) -> int:
    """Run the demo; it prints its own answers."""
    from liftcore.demo.run import run_demo

    return run_demo(options.scene, options.out, options.json, options.ask)
