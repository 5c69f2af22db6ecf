"""What the documents tell people to type, open and set exists."""

from __future__ import annotations

import argparse
import json
import re
import shlex

import pytest

from liftcore.cli import build_parser
from liftcore.solve.settings import LiftSettings, Preset
from service.settings import ServiceSettings

from .readme import DOCUMENTS, ROOT, blocks, table_heads, text


@pytest.mark.parametrize("document", DOCUMENTS)
def test_relative_links_lead_somewhere(document: str) -> None:
    links = re.findall(r"\]\(([^)#]+)", text(document))
    missing = [link for link in links if "://" not in link and not (ROOT / link).exists()]
    assert not missing


def test_named_sources_exist() -> None:
    named = set(re.findall(r"`([a-z_/]+\.py)`", text("ARCHITECTURE.md")))
    missing = [
        name for name in named if not any((ROOT / room / name).is_file() for room in ("", "liftcore", "service"))
    ]
    assert named
    assert not missing


@pytest.mark.parametrize("document", DOCUMENTS)
def test_make_targets_exist(document: str) -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z]+):", makefile, flags=re.MULTILINE))
    named = set(re.findall(r"(?:`|^)make ([a-z]+)", text(document), flags=re.MULTILINE))
    assert named
    assert named <= targets


def test_readme_opens_with_the_two_commands() -> None:
    first = blocks("README.md", "sh")[0]
    assert [line.split("#")[0].strip() for line in first.splitlines()] == ["make demo", "make test"]


def test_ci_runs_the_readmes_test_command() -> None:
    assert "make test" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def test_commands_of_the_readme_parse() -> None:
    lines = [line for block in blocks("README.md", "sh") for line in block.splitlines()]
    commands = [shlex.split(line)[1:] for line in lines if line.startswith("splatlift ")]
    assert commands
    for command in commands:
        assert build_parser().parse_args(command).command == command[0]


def test_every_command_is_in_the_readme_with_its_options() -> None:
    parsers = _commands()
    rows = {head.strip("`"): row for head, row in _command_rows().items()}
    assert rows.keys() == {f"splatlift {name}" for name in parsers}
    for name, parser in parsers.items():
        known = {option for action in parser._actions for option in action.option_strings}
        assert set(re.findall(r"--[a-z-]+", rows[f"splatlift {name}"])) <= known | _pack_options(parser)


def test_every_setting_of_a_lift_is_in_the_readme_with_its_default() -> None:
    rows = dict(re.findall(r"^\| `([a-z_]+)` \| (.*?) \|", text("README.md"), flags=re.MULTILINE))
    for name, default in LiftSettings.of().model_dump(mode="json").items():
        shown = rows[name].split(" (")[0].strip("`")
        assert shown in (str(default), json.dumps(default)) or float(shown) == default, name


def test_every_preset_is_in_the_readme() -> None:
    heads = " ".join(table_heads("README.md"))
    assert all(f"`{preset}`" in heads for preset in Preset)


def test_every_setting_of_the_service_is_in_the_readme() -> None:
    named = {head.strip("`") for head in table_heads("README.md") if head.startswith("`SPLATLIFT_")}
    assert named == {f"SPLATLIFT_{field.upper()}" for field in ServiceSettings.model_fields}


def _commands() -> dict[str, argparse.ArgumentParser]:
    actions = build_parser()._actions
    return next(dict(action.choices) for action in actions if isinstance(action, argparse._SubParsersAction))


def _command_rows() -> dict[str, str]:
    return dict(re.findall(r"^\| (`splatlift [a-z]+`) \| (.*) \|$", text("README.md"), flags=re.MULTILINE))


def _pack_options(parser: argparse.ArgumentParser) -> set[str]:
    nested = [action.choices for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    formats = [child for choices in nested for child in choices.values()]
    return {option for child in formats for action in child._actions for option in action.option_strings}
