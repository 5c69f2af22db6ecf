"""Hover texts of the library in an editor: shapes of arrays, and types that strict checkers accept."""

import ast
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import liftcore as lc

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
ARRAYS = re.compile(r"\b(Tensor|np\.ndarray)\b")
SHAPE = re.compile(r"\[[A-Za-z0-9_]+( [+*] \d)?(, ?[A-Za-z0-9_.]+)*\]")


def array_fields() -> list[tuple[str, str, str]]:
    """Return class, field and docstring of the field, for each array of a public value."""
    fields = []
    for name in lc.__all__:
        value = getattr(lc, name)
        if not inspect.isclass(value) or value.__module__.split(".")[0] != "liftcore":
            continue
        for cls in value.__mro__[:-1]:
            if cls.__module__.split(".")[0] != "liftcore":
                continue
            source = inspect.getsourcefile(cls) or ""
            tree = ast.parse(Path(source).read_text(encoding="utf-8"))
            bodies = [node.body for node in tree.body if isinstance(node, ast.ClassDef) and node.name == cls.__name__]
            for body in bodies:
                for field, after in zip(body, [*body[1:], None], strict=True):
                    public = isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
                    if not public or field.target.id.startswith("_"):  # pyright: ignore
                        continue
                    if not ARRAYS.search(ast.unparse(field.annotation)):  # pyright: ignore
                        continue
                    text = after.value.value if isinstance(after, ast.Expr) else ""  # pyright: ignore
                    fields.append((cls.__name__, field.target.id, str(text)))  # pyright: ignore
    return fields


def test_every_array_of_a_public_value_shows_its_shape_where_it_is_pointed_at() -> None:
    fields = array_fields()
    assert {"Lift", "Splats", "Camera", "Regions", "FeatureGrid", "RegionWeights"} <= {name for name, *_ in fields}
    assert [field[:2] for field in fields if not SHAPE.search(field[2])] == []


@pytest.mark.parametrize("name", ["lift", "plan", "render", "region_weights", "read_splats", "write_splats"])
def test_docstrings_name_every_argument(name: str) -> None:
    function = getattr(importlib.import_module("liftcore"), name)
    doc = inspect.getdoc(function) or ""
    arguments = [argument for argument in inspect.signature(function).parameters if argument != "settings"]
    assert [argument for argument in arguments if not re.search(rf"\b{argument}\b", doc)] == []


@pytest.mark.slow
def test_a_users_scripts_are_of_strict_types() -> None:
    assert EXAMPLES and all(path.read_text().startswith("# pyright: strict\n") for path in EXAMPLES)
    checker = [sys.executable, "-m", "basedpyright", "--pythonpath", sys.executable, *map(str, EXAMPLES)]
    process = subprocess.run(checker, cwd=ROOT, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stdout
