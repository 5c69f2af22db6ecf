"""Commands, addresses and settings of the documents exist."""

from __future__ import annotations

import argparse
import ast
import json
import re
import shlex
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from liftcore import Query
from liftcore.cli import COMMANDS, SERVICE_COMMANDS, build_parser
from liftcore.values.settings import LiftSettings, Preset, Quality
from service.settings import ServiceSettings

from .readme import (
    DOCUMENTS,
    FOR_USERS,
    GUIDE,
    PAGES,
    PYTHON,
    RESULTS,
    ROOT,
    SERVICE,
    SETTINGS,
    blocks,
    inline_code,
    shell_commands,
    site_text,
    table_heads,
    text,
)


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


@pytest.mark.parametrize("document", PAGES)
def test_sources_modules_and_make_targets_that_are_named_exist(document: str) -> None:
    sources = {code for code in inline_code(document) if re.fullmatch(r"[\w/*]+\.py", code)}
    folders = [ROOT / folder for folder in ("", "liftcore", "service")]
    assert not [name for name in sources if not any([*folder.glob(name)] for folder in folders)]
    assert sources or document != "ARCHITECTURE.md"
    modules = set(re.findall(r"python -m ([a-z_]+(?:\.[a-z_]+)*)", text(document)))
    assert not [name for name in modules if find_spec(name) is None]
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"(?:`|^)make ([a-z]+)", text(document), flags=re.MULTILINE))
    assert targets <= set(re.findall(r"^([a-z]+):", makefile, flags=re.MULTILINE))
    assert targets or document not in ("README.md", "CONTRIBUTING.md")


def test_every_page_of_the_guide_is_in_the_readme() -> None:
    linked = set(re.findall(r"\]\((docs/[\w-]+\.md)", text("README.md")))
    assert linked == set(PAGES) - set(DOCUMENTS)


def test_readme_opens_with_the_two_commands() -> None:
    first = blocks("README.md", "sh")[0]
    assert [line.split("#")[0].strip() for line in first.splitlines()] == ["make demo", "make test"]


def test_ci_runs_the_readmes_test_command() -> None:
    assert "make test" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def test_commands_of_the_guide_parse() -> None:
    commands = [shlex.split(command) for page in FOR_USERS for command in shell_commands(page)]
    assert {"pack", "lift", "query", "serve", "keys", "tradeoff"} <= {command[0] for command in commands}
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


def test_commands_that_errors_and_hints_name_exist() -> None:
    documented = {words for folder in ("liftcore", "service") for words in _named_in_sentences(ROOT / folder)}
    assert {"pack retag", "keys create", "store rebuild", "pack npy"} <= {" ".join(words) for words in documented}
    for words in documented:
        parser = _commands()[words[0]]
        nested = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
        assert not nested or len(words) == 1 or words[1] in nested[0].choices, words
        options = {option for action in _actions(parser) for option in action.option_strings}
        assert {word for word in words if word.startswith("--")} <= options, words


def _named_in_sentences(folder: Path) -> Iterator[tuple[str, ...]]:
    """Commands with their options, of all strings of the sources but names of programs."""
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts = (part.value if isinstance(part, ast.Constant) else "X" for part in node.values)
                sentence = "".join(map(str, parts))
            else:
                sentence = node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""
            for command_text in re.findall(r"splatlift ([a-z]+(?: (?:--?)?[\w./={}-]+)*)", sentence):
                command, *words = command_text.split()
                if command in _commands():
                    nested = words[:1] if command in ("pack", "keys", "store") else []
                    yield (command, *nested, *(word.rstrip(".") for word in words if word.startswith("--")))


def test_every_command_is_documented_and_every_option_has_help() -> None:
    parsers = _commands()
    sentences = (code.removeprefix("splatlift ") for code in inline_code(GUIDE) if code.startswith("splatlift "))
    sentence = {command.split()[0] for command in (*shell_commands(GUIDE), *sentences)}
    assert parsers.keys() <= sentence and all((SERVICE_COMMANDS | COMMANDS).values())
    for name, parser in parsers.items():
        assert not [action.dest for action in _actions(parser) if action.option_strings and not action.help], name


def test_every_setting_of_a_lift_is_in_the_sites_table_with_its_default() -> None:
    section = site_text(SETTINGS).partition("## All settings")[2].partition("\n## ")[0]
    rows = {
        name: cells for name, *cells in re.findall(r"^\| `([a-z_]+)` \| (.*?) \| (.*) \|$", section, re.MULTILINE)
    }
    for name, default in LiftSettings.of().model_dump(mode="json").items():
        default_cell, meaning = rows[name]
        assert default_cell.split(" (")[0].strip("`") in (str(default), json.dumps(default)), name
        assert meaning.replace(r"\|", "|") == LiftSettings.model_fields[name].description, name
    assert rows["k"][0] == "`40` (`argmax`: `1`)" and rows["robust_steps"][0] == "`1` (the other presets: `0`)"


def test_every_speed_is_in_the_sites_table_with_what_it_sets() -> None:
    section = site_text(RESULTS).partition("### Speed against accuracy")[2].partition("\n### ")[0]
    head, _, *rows = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("|")]
    for row, level in zip(rows, Quality, strict=True):
        values = LiftSettings.of(quality=level).model_dump(mode="json")
        names = [name.strip("`") for name in head]
        expected = [json.dumps(values[name]).strip(chr(34)) for name in names]
        assert [cell.strip("`") for cell in row] == expected, level
        assert {name for name, value in LiftSettings.of(quality="exact") if values[name] != value} <= {*names}, level


def test_help_of_a_lift_lists_every_setting_with_its_default_and_meaning_in_a_group(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    names = [name for group in LiftSettings.groups().values() for name in group]
    assert sorted(names) == sorted(LiftSettings.model_fields)
    with pytest.raises(SystemExit, match="0"):
        build_parser().parse_args(["lift", "--help"])
    lines = capsys.readouterr().out.partition("settings of a lift")[2]
    assert re.findall(r"^    ([a-z_]+)=", lines, flags=re.MULTILINE) == names
    assert max(map(len, lines.splitlines())) <= 80
    for name, default in LiftSettings.of().model_dump(mode="json").items():
        meaning = " ".join((LiftSettings.model_fields[name].description or "").replace("`", "").split())
        assert f"{name}={json.dumps(default).strip(chr(34))}: {meaning}" in " ".join(lines.split()), name


def test_every_field_of_a_question_is_in_the_sites_table_with_its_default() -> None:
    rows = dict(re.findall(r"^\| `([a-z_]+)` \| (.*) \|$", site_text(PYTHON), flags=re.MULTILINE))
    for name, field in Query.model_fields.items():
        default = "none" if field.default in (None, []) else f"`{field.default}`"
        assert field.description and rows[name] == f"{default} | {field.description}", name


def test_every_preset_is_documented() -> None:
    heads = " ".join(table_heads(SETTINGS))
    assert all(f"`{preset}`" in heads for preset in Preset)


def test_the_services_help_lists_every_setting_with_its_default_and_meaning(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit, match="0"):
        build_parser().parse_args(["serve", "--help"])
    lines = capsys.readouterr().out.partition("environment variables")[2]
    sentence = dict(re.findall(r"^  SPLATLIFT_([A-Z_]+), default (.*)$", lines, flags=re.MULTILINE))
    assert sentence.keys() == {field.upper() for field in ServiceSettings.model_fields}
    for name, field in ServiceSettings.model_fields.items():
        default = field.get_default(call_default_factory=True)
        assert sentence[name.upper()].split(" (")[0] == ("not set" if default in (None, ()) else str(default)), name
        assert field.description and " ".join(field.description.split()) in " ".join(lines.split()), name


def test_documented_settings_of_the_service_exist_and_have_that_default() -> None:
    sentence = dict(re.findall(r"^\| `SPLATLIFT_([A-Z_]+)` \| (.*?) \|", text(SERVICE), flags=re.MULTILINE))
    assert {"DATA", "HOST", "KEYS", "TEXT_SPACES"} <= sentence.keys()
    for name, documented_default in sentence.items():
        default = ServiceSettings.model_fields[name.lower()].get_default(call_default_factory=True)
        assert documented_default.split(" (")[0].strip("`") == ("-" if default in (None, (), "") else str(default)), (
            name
        )
    documented = {name.lower() for page in PAGES for name in re.findall(r"SPLATLIFT_([A-Z_]+)", text(page))}
    assert documented - {"key"} <= ServiceSettings.model_fields.keys()


def _commands() -> dict[str, argparse.ArgumentParser]:
    actions = build_parser()._actions
    choices = next(action.choices for action in actions if isinstance(action, argparse._SubParsersAction))
    return {name: parser.add_options() for name, parser in choices.items()}


def _actions(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """The options and arguments of a command, with those of its formats or actions."""
    nested = [action.choices for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    children = [child for choices in nested for child in choices.values()]
    return [action for each in (parser, *children) for action in each._actions]
