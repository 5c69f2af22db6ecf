"""The digest that names the kernel folder covers what kernels take from other files."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import liftcore
from liftcore.runtime.jit import SHARED_SOURCES

COMPILING = {"kernel", "inlined", "vectorised", "without_zero_checks", "compiled"}  # decorators
ROOT = Path(liftcore.__file__).parent
WITH_KERNELS = [path for path in sorted(ROOT.rglob("*.py")) if "from liftcore.runtime.jit import" in path.read_text()]


def compiled_names(path: Path) -> set[str]:
    """Return the functions that a file defines for compiled code: kernels, intrinsics, decorated helpers."""
    names = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef) and COMPILING & {
            ast.unparse(decorator) for decorator in node.decorator_list
        }:
            names.add(node.name)
    return names


@pytest.mark.parametrize("path", WITH_KERNELS, ids=lambda path: path.stem)
def test_whatever_a_kernel_calls_elsewhere_is_in_the_digest(path: Path) -> None:
    for node in ast.parse(path.read_text()).body:
        if not (isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("liftcore.")):
            continue
        source = ROOT.joinpath(*node.module.split(".")[1:]).with_suffix(".py")
        if not source.exists() or str(source.relative_to(ROOT)) in SHARED_SOURCES or source not in WITH_KERNELS:
            continue
        assert not compiled_names(source) & {name.name for name in node.names}, source
