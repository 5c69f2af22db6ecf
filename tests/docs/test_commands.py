"""Commands, addresses and settings of the documents exist."""

from __future__ import annotations

import argparse
import json
import re
import shlex

import pytest

from liftcore import LiftSettings
from liftcore.cli import build_parser
from liftcore.values.settings import Quality
from service.settings import ServiceSettings

from .readme import FOR_USERS, PAGES, ROOT, SERVICE, inline_code, shell_commands, text


@pytest.mark.parametrize("document", PAGES)
def test_links_lead_to_files_and_headings(document: str) -> None:
    for page, place in re.findall(r"\]\(([^)#]*)(?:#([^)]+))?\)", text(document)):
        target = (ROOT / document).parent / page if page else ROOT / document
        if "://" in page:
            continue
        assert target.exists(), page
        if place:
            headings = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), flags=re.MULTILINE)
            assert place in {re.sub(r"[^a-z0-9 -]", "", head.lower()).replace(" ", "-") for head in headings}, place


def test_commands_of_the_guide_parse() -> None:
    commands = [shlex.split(command) for page in FOR_USERS for command in shell_commands(page)]
    assert {"pack", "lift", "query", "serve", "keys"} <= {command[0] for command in commands}
    for command in commands:
        assert build_parser().parse_args(command).command == command[0]


@pytest.mark.parametrize("document", PAGES)
def test_commands_within_sentences_and_tables_parse(document: str, capsys: pytest.CaptureFixture[str]) -> None:
    codes = [code.removeprefix(".venv/bin/") for code in inline_code(document)]
    for command in (shlex.split(code)[1:] for code in codes if code.startswith("splatlift ")):
        options = {option for action in _actions(_commands()[command[0]]) for option in action.option_strings}
        assert {word for word in command if word.startswith("--")} <= options, command
        try:
            build_parser().parse_args(command)
        except SystemExit as end:  # it asks for help, names a command and no more, or has NAME for one of its words
            output = capsys.readouterr().err
            assert not end.code or "arguments are required" in output or "choice: 'NAME'" in output, output


def test_documented_settings_of_the_service_exist_and_have_that_default() -> None:
    sentence = dict(re.findall(r"^\| `SPLATLIFT_([A-Z_]+)` \| (.*?) \|", text(SERVICE), flags=re.MULTILINE))
    assert {"DATA", "HOST", "TEXT_SPACES"} <= sentence.keys()
    for name, documented_default in sentence.items():
        default = ServiceSettings.model_fields[name.lower()].get_default(call_default_factory=True)
        assert documented_default.split(" (")[0].strip("`") == ("-" if default in (None, (), "") else str(default)), (
            name
        )
    documented = {name.lower() for page in PAGES for name in re.findall(r"SPLATLIFT_([A-Z_]+)", text(page))}
    assert documented - {"key"} <= ServiceSettings.model_fields.keys()


def test_documented_levels_of_quality_set_what_the_table_says() -> None:
    lines = text("docs/results.md").partition("\nquality | ")[2].split("\n\n")[0].splitlines()
    head, *rows = ([cell.strip("` ") for cell in line.split("|")] for line in lines if "---" not in line)
    levels = {level.value: LiftSettings.of(quality=level).model_dump(mode="json") for level in Quality}
    exact = levels["exact"]
    differing = {name for values in levels.values() for name in values if values[name] != exact[name]}
    assert set(head) == differing - {"quality"} and len(rows) == len(levels)
    for level, *cells in rows:
        assert cells == [json.dumps(levels[level][name]).strip('"') for name in head]


def test_table_of_settings_has_each_with_its_default() -> None:
    rows = re.findall(r"^`(\w+)` \| `(\S+)` \| \S", text("docs/settings.md"), flags=re.MULTILINE)
    defaults = LiftSettings.of().model_dump(mode="json")
    assert rows == [(name, json.dumps(value).strip('"')) for name, value in defaults.items()]


def _commands() -> dict[str, argparse.ArgumentParser]:
    actions = build_parser()._actions
    choices = next(action.choices for action in actions if isinstance(action, argparse._SubParsersAction))
    return {name: parser.add_options() for name, parser in choices.items()}


def _actions(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """The options and arguments of a command, with those of its formats or actions."""
    nested = [action.choices for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    children = [child for choices in nested for child in choices.values()]
    return [action for each in (parser, *children) for action in each._actions]
