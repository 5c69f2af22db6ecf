"""The docs site (`make docs`): the pages and the notebook here, and a reference from docstrings of public modules."""

import re
import tomllib
from pathlib import Path
from typing import Any

import liftcore

ROOT = Path(__file__).parents[1]

project = "splatlift"
author = "The splatlift authors"
release = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["requirements.txt"]
html_theme = "furo"
html_title = f"splatlift {release}"
nb_execution_mode = "off"  # the notebook shows its stored outputs; a test runs it
default_role = "code"  # docstrings name code in single backticks
myst_heading_anchors = 4
autodoc_typehints = "signature"
autodoc_member_order = "groupwise"
autodoc_default_options = {"members": True, "exclude-members": "model_config, model_post_init"}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
suppress_warnings = ["ref.python"]  # a value that several public modules offer has one text


NAMES = "(all names of liftcore)"  # in reference.rst: autodoc does not see what is loaded at first use


def list_names() -> str:
    """Directives for each public name of `liftcore`."""
    kinds = {name: "class" if isinstance(getattr(liftcore, name), type) else "function" for name in liftcore.__all__}
    return "\n".join(f".. auto{kind}:: liftcore.{name}\n" for name, kind in kinds.items())


def prepare_page(_app: Any, _page: str, source: list[str]) -> None:
    """Put the names into a page's source, and names of files of the checkout in place of links to them."""
    text = source[0].replace(NAMES, list_names()) if NAMES in source[0] else source[0]
    source[0] = re.sub(r"\[([^\]]*)\]\(\.\./[^)]*\)", r"\1", text)


def setup(app: Any) -> None:
    app.connect("source-read", prepare_page)
