"""Hold names, docstrings and texts to plain words: ``python -m tests.wording``.

Three kinds of places are counted.

- names: variables, parameters, attributes, fields, functions and classes whose whole name is a bare participle or a
  riddle (`found`, `given`, `thing`). A name is a noun of the field, a function a verb with its object.
- docstrings: those that begin with a question word. They begin with an imperative or a noun phrase.
- told: the word itself, in code, docs and messages.

The bars are shares of the tree (`BARS`): above one the check fails and lists the places. ``--list [PATH...]`` prints
every place, ``--names`` the counts of each name.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
KINDS = ("names", "docstrings", "told")
CODE = ("liftcore/**/*.py", "service/**/*.py", "tests/**/*.py", "examples/**/*.py")
TEXTS = ("*.md", "Makefile", "docs/*.md", "docs/*.rst", "docs/*.ipynb", "docker/*", "service/web/src/**/*.[chj]*")
# History stays as it was written; the others must name the words.
UNBOUND = ("CHANGELOG.md", "CONTRIBUTING.md", "tests/wording.py", "tests/unit/test_wording_check.py")
# Kind -> the most places: a share of functions or of docstrings, or a number
BARS = {"names": 0.01, "docstrings": 0.02, "told": 5}

# A participle says that something was done to a value, not what the value is. Terms of the field are not listed, such
# as `expected` and `got` of an error, `lifted` features, `projected`, `merged`, `created` of a row, states of a job.
PARTICIPLE_LINES = """
    added allowed announced answered asked begun bent born bought brought built caught changed checked chosen
    claimed come compared counted covered decided declared described died divided done drawn dropped eaten elected
    ended explained fed felt filled followed forgotten found freed gathered given gone grown guarded handed heard
    held hidden joined judged kept killed known learnt left lent listed lit logged looked lost made marked meant
    met missed mixed moved named needed noted numbered opened owned parted permitted picked placed posed printed
    promised put reached read received refused remembered removed renamed repeated ruled said seen sent served
    shown skipped sought spent spoken started stated stood stopped taken taught thought thrown told touched tried
    turned understood uploaded used waited walked wanted warned watched weighed worded written
"""
# A riddle has to be guessed: a pronoun, a question word, a picture. `near`, `inside`, `lower` are terms of geometry.
RIDDLE_LINES = """
    again ahead alike alone anew another anybody anyone anything apart beside both dial either elsewhere enough
    errand every everybody everyone everything fewer hers here house how judge judges lean light look looks many
    mine more most neither nobody nothing nowhere one others ours own pilot plain room rooms same some somebody
    something stranger stray strays tell teller theirs there thing things together trouble usual walk walks what
    when where which who whole whom whose why
"""
PARTICIPLES, RIDDLES = frozenset(PARTICIPLE_LINES.split()), frozenset(RIDDLE_LINES.split())
VERBS = frozenset({"put", "read", "where"})  # names of functions in libraries and protocols, riddles as values alone
SIDES = frozenset({"right", "top", "bottom"})  # beside one of these, `left` is a side
QUESTIONS = frozenset({"what", "whether", "how", "who", "whom", "whose", "which", "where", "when", "why"})
TOLD = re.compile(r"(?<![a-z])told(?![a-z])", re.IGNORECASE)

Function = ast.FunctionDef | ast.AsyncFunctionDef
Scope = Function | ast.ClassDef | ast.Module
Place = tuple[int, str]  # a line from 1, and what stands there


@dataclass
class Report:
    """Places of each kind in one file, and the functions and docstrings among which they are."""

    places: dict[str, list[Place]] = field(default_factory=lambda: {kind: [] for kind in KINDS})
    functions: int = 0
    functions_with_participle: int = 0  # that bind one, or are called one
    docstrings: int = 0

    def counts(self) -> dict[str, int]:
        """Return the number of places of each kind that the file has."""
        return {kind: len(places) for kind, places in self.places.items() if places}


def report_on_code(text: str) -> Report:
    """Report on the Python module with this source."""
    report, scopes = Report(), [ast.parse(text)]
    for scope in scopes:
        nodes = nodes_of(scope)
        scopes += [node for node in nodes if isinstance(node, Scope)]
        bindings = [place for node in nodes for place in bound_names(node)]
        listed = [place for place in bindings if is_listed(place[1], {name for _, name in bindings})]
        if isinstance(scope, Function | ast.ClassDef) and is_listed(scope.name, function=True):
            listed.append((scope.lineno, scope.name))
        report.places["names"] += listed
        if isinstance(scope, Function):
            report.functions += 1
            report.functions_with_participle += any(name.strip("_").lower() in PARTICIPLES for _, name in listed)
        docstring = ast.get_docstring(scope)
        if docstring and (words := re.findall(r"[^\W_]+", docstring)):
            report.docstrings += 1
            if words[0].lower() in QUESTIONS:
                report.places["docstrings"].append((scope.body[0].lineno, " ".join(words[:4])))
    report.places["told"] = lines_with_told(text)
    for places in report.places.values():
        places.sort()
    return report


def report_on_text(text: str) -> Report:
    """Report on a text that is no Python: the word "told" alone."""
    report = Report()
    report.places["told"] = lines_with_told(text)
    return report


def lines_with_told(text: str) -> list[Place]:
    """Return the line of each "told", also as a part of a name."""
    lines = enumerate(text.splitlines(), 1)
    return [(number, line.strip()[:60]) for number, line in lines for _ in TOLD.finditer(line)]


def is_listed(name: str, beside: Collection[str] = (), *, function: bool = False) -> bool:
    """Tell whether a whole name is a participle or a riddle, given the names that its scope binds `beside` it."""
    word = name.strip("_").lower()
    if (function and word in VERBS) or (word == "left" and not SIDES.isdisjoint(beside)):
        return False
    return word in PARTICIPLES or word in RIDDLES


def nodes_of(scope: Scope) -> list[ast.AST]:
    """Return the nodes of a scope, with the scopes inside of it and not with what these hold.

    Lambdas and comprehensions count as part of the scope that they are in.
    """
    nodes: list[ast.AST] = [*ast.iter_child_nodes(scope)]
    for node in nodes:
        if not isinstance(node, Scope):
            nodes += ast.iter_child_nodes(node)
    return nodes


def bound_names(node: ast.AST) -> Iterator[Place]:
    """Yield the name that a node binds: a parameter, a target, an attribute assigned, a field, an `as` name."""
    match node:
        case ast.Name(ctx=ast.Store(), id=name) | ast.Attribute(ctx=ast.Store(), attr=name) | ast.arg(arg=name):
            yield node.lineno, name
        case ast.alias(asname=str(name)) | ast.ExceptHandler(name=str(name)):
            yield node.lineno, name
        case ast.MatchAs(name=str(name)) | ast.MatchStar(name=str(name)):
            yield node.lineno, name


def files_of(patterns: Iterable[str]) -> list[Path]:
    """Return the files that patterns match, in order, without those that no bound holds."""
    files = {path.relative_to(ROOT) for pattern in patterns for path in ROOT.glob(pattern) if path.is_file()}
    project_files = (path for path in files if path.as_posix() not in UNBOUND and "node_modules" not in path.parts)
    return [ROOT / path for path in sorted(project_files)]


def report_on_tree() -> dict[str, Report]:
    """Return the report on each file of the project, by its path from the root."""
    reports = {path: report_on_code(path.read_text("utf-8")) for path in files_of(CODE)}
    reports |= {path: report_on_text(path.read_text("utf-8")) for path in files_of(TEXTS) if path.suffix != ".py"}
    return {path.relative_to(ROOT).as_posix(): report for path, report in reports.items()}


def summary(reports: Collection[Report]) -> str:
    """Return the counts over all files, in one line."""
    names = sum(len(report.places["names"]) for report in reports)
    participles = sum(report.functions_with_participle for report in reports)
    functions = sum(report.functions for report in reports)
    questions = sum(len(report.places["docstrings"]) for report in reports)
    docstrings = sum(report.docstrings for report in reports)
    told = sum(len(report.places["told"]) for report in reports)
    return (
        f"{names} names listed; functions with a bare participle {participles} of {functions}"
        f" ({participles / functions:.1%}); docstrings with a question word {questions} of {docstrings}"
        f" ({questions / docstrings:.1%}); told {told}"
    )


def excess(reports: dict[str, Report]) -> Iterator[str]:
    """Yield the lines of each bar that is exceeded: the count and the bar, then every place."""
    wholes = {
        "names": sum(report.functions for report in reports.values()),
        "docstrings": sum(report.docstrings for report in reports.values()),
        "told": 1,
    }
    for kind, bar in BARS.items():
        places = [(path, *place) for path, report in reports.items() for place in report.places[kind]]
        if len(places) > bar * wholes[kind]:
            yield f"{len(places)} {kind}, at most {int(bar * wholes[kind])} may stay:"
            yield from (f"  {path}:{line} {name}" for path, line, name in places)


def main() -> int:
    """Check the tree against the bars, or list what is there; 1 if a count is above its bar."""
    parser = argparse.ArgumentParser(prog="python -m tests.wording", description="Hold the code to plain words.")
    parser.add_argument("--list", nargs="*", metavar="PATH", help="print every place, of paths that begin so")
    parser.add_argument("--names", action="store_true", help="print each listed name with its count")
    options = parser.parse_args()
    reports = report_on_tree()
    if options.names:
        names = Counter(name.strip("_") for report in reports.values() for _, name in report.places["names"])
        print("\n".join(f"{count} {name}" for name, count in names.most_common()))
    if options.list is not None:
        prefixes = tuple(options.list) or ("",)
        for path, report in reports.items():
            if path.startswith(prefixes):
                places = ((kind, place) for kind in KINDS for place in report.places[kind])
                print("".join(f"{path}:{line} {name} ({kind})\n" for kind, (line, name) in places), end="")
    above = list(excess(reports))
    if above:
        print("\n".join(above), "names and docstrings in plain words: CONTRIBUTING.md, Names", sep="\n")
    print(summary(reports.values()))
    return 1 if above else 0


if __name__ == "__main__":
    sys.exit(main())
