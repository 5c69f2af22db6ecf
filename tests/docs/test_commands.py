"""Commands, addresses and settings of the documents exist."""

from __future__ import annotations

import argparse
import ast
import re
import shlex
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from liftcore.cli import build_parser
from liftcore.values.settings import Preset
from service.settings import ServiceSettings

from .readme import (
    DOCUMENTS,
    FOR_USERS,
    GUIDE,
    PAGES,
    ROOT,
    SERVICE,
    SETTINGS,
    inline_code,
    shell_commands,
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
    assert {"pack", "keys"} <= {words[0] for words in documented}
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


def test_every_command_is_in_the_guide_and_every_option_has_help() -> None:
    parsers = _commands()
    inline = (code.removeprefix("splatlift ") for code in inline_code(GUIDE) if code.startswith("splatlift "))
    assert parsers.keys() <= {command.split()[0] for command in (*shell_commands(GUIDE), *inline)}
    for name, parser in parsers.items():
        assert not [action.dest for action in _actions(parser) if action.option_strings and not action.help], name


def test_every_preset_is_documented() -> None:
    heads = " ".join(table_heads(SETTINGS))
    assert all(f"`{preset}`" in heads for preset in Preset)


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


def _commands() -> dict[str, argparse.ArgumentParser]:
    actions = build_parser()._actions
    choices = next(action.choices for action in actions if isinstance(action, argparse._SubParsersAction))
    return {name: parser.add_options() for name, parser in choices.items()}


def _actions(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """The options and arguments of a command, with those of its formats or actions."""
    nested = [action.choices for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    children = [child for choices in nested for child in choices.values()]
    return [action for each in (parser, *children) for action in each._actions]
