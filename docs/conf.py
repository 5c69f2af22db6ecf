"""The docs site (`make docs`): the pages and the notebook here, and a reference from docstrings of public modules.

Tables that repeat what code says are in no page: a comment of a page, such as ``<!-- settings -->``, stands where the
site has one of `TABLES`.
"""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import liftcore
from liftcore.values.settings import Preset

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


def table(*rows: tuple[str, ...]) -> str:
    """Return a Markdown table, whose first row is its head."""
    cells = ([cell.replace("|", "\\|") for cell in row] for row in rows)
    head, *body = (f"| {' | '.join(row)} |" for row in cells)
    return "\n".join([head, "|---" * len(rows[0]) + "|", *body])


def table_of_settings() -> str:
    """Return each setting of a lift with its default, those of presets that have another, and its meaning."""
    settings_of = liftcore.LiftSettings.of
    defaults = settings_of().model_dump(mode="json")
    presets = {preset.value: settings_of(preset=preset).model_dump(mode="json") for preset in Preset}

    def default_of(name: str) -> str:
        exceptions = {preset: values[name] for preset, values in presets.items() if values[name] != defaults[name]}
        if name == "preset" or not exceptions:
            return f"`{code(defaults[name])}`"
        if len(exceptions) == len(presets) - 1 and len({*exceptions.values()}) == 1:
            return f"`{code(defaults[name])}` (the other presets: `{code(next(iter(exceptions.values())))}`)"
        others = (f"`{preset}`: `{code(value)}`" for preset, value in exceptions.items())
        return f"`{code(defaults[name])}` ({', '.join(others)})"

    fields = liftcore.LiftSettings.model_fields
    return table(
        ("setting", "default", "meaning"),
        *((f"`{name}`", default_of(name), field.description or "") for name, field in fields.items()),
    )


def code(value: Any) -> str:
    """Return a value as people type it after `--set NAME=`."""
    return json.dumps(value).strip('"')


TABLES = {
    "settings": table_of_settings,
}


def fill_page(text: str) -> str:
    """Return a page with its tables, and names of files of the checkout in place of links to them."""
    text = re.sub(
        r"<!-- ([a-z ]+) -->",
        lambda comment: TABLES[comment[1]](),
        text.replace(NAMES, list_names() if NAMES in text else ""),
    )
    return re.sub(r"\[([^\]]*)\]\(\.\./[^)]*\)", r"\1", text)


def prepare_page(_app: Any, _page: str, source: list[str]) -> None:
    """Fill the source of a page in place."""
    source[0] = fill_page(source[0])


def setup(app: Any) -> None:
    app.connect("source-read", prepare_page)
