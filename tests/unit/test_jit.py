"""The digest that names the kernel folder covers all that kernels are made of."""

from __future__ import annotations

import ast
from pathlib import Path

import liftcore
from liftcore.jit import _kernel_sources

ROOT = Path(liftcore.__file__).parent


def _imported(source: Path) -> set[Path]:
    """The project's files that a file imports when it runs (not for its types alone)."""
    found = set()
    for node in ast.parse(source.read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("liftcore."):
            found.add(ROOT.joinpath(*node.module.split(".")[1:]).with_suffix(".py"))
    return found


# What kernel modules import for their plain Python code; kernels take no value from them.
_NO_PART_OF_KERNELS = {
    "accumulate.py",
    "columns.py",
    "errors.py",
    "feature_room.py",
    "gathering.py",
    "host.py",
    "one_thread.py",
    "readout.py",
    "protocol.py",
    "splats.py",
    "progress.py",
    "observation.py",
    "view_weights.py",
}


def test_whatever_a_kernel_takes_a_name_from_is_in_the_digest():
    digested = set(_kernel_sources())
    for source in digested:
        missing = {file for file in _imported(source) - digested if file.name not in _NO_PART_OF_KERNELS}
        assert not missing, f"{source.name} takes names from files that the digest does not see"


def test_every_file_with_kernels_is_in_the_digest():
    digested = set(_kernel_sources())
    for source in ROOT.rglob("*.py"):
        if "from liftcore.jit import" in source.read_text():
            assert source in digested, source
