"""Hold names and docstrings to plain words: ``python -m tests.wording``.

A whole name that is a bare participle or a riddle (`found`, `given`, `thing`) counts, wherever it is bound; so does a
docstring that begins with a question word. All places are printed where there are more than `MOST_PLACES`.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MOST_PLACES = 44  # it only falls
QUESTIONS = frozenset({"what", "whether", "how", "who", "whom", "whose", "which", "where", "when", "why"})
# Terms of the field are not listed, such as `expected` and `got` of an error, `lifted` features, states of a job; nor
# are names that libraries and protocols use: `read`, `put`, `where`, `left` of a side.
LISTED_WORDS = """
    added allowed announced answered asked begun bent born bought brought built caught changed checked chosen
    claimed come compared counted covered decided declared described died divided done drawn dropped eaten elected
    ended explained fed felt filled followed forgotten found freed gathered given gone grown guarded handed heard
    held hidden joined judged kept killed known learnt lent listed lit logged looked lost made marked meant
    met missed mixed moved named needed noted numbered opened owned parted permitted picked placed posed printed
    promised reached received refused remembered removed renamed repeated ruled said seen sent served
    shown skipped sought spent spoken started stated stood stopped taken taught thought thrown told touched tried
    turned understood uploaded used waited walked wanted warned watched weighed worded written
    again ahead alike alone anew another anybody anyone anything apart beside both dial either elsewhere enough
    errand every everybody everyone everything fewer hers here house how judge judges lean light look looks many
    mine more most neither nobody nothing nowhere one others ours own pilot plain room rooms same some somebody
    something stranger stray strays tell teller theirs there thing things together trouble usual walk walks what
    when which who whole whom whose why
"""
RIDDLES = frozenset(LISTED_WORDS.split())


def listed_places(source: str) -> Iterator[tuple[int, str]]:
    """Yield the line and the words of each listed name and of each docstring that begins with a question word."""
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Name(ctx=ast.Store(), id=name) | ast.Attribute(ctx=ast.Store(), attr=name) | ast.arg(arg=name):
                if is_listed(name):
                    yield node.lineno, name
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                if is_listed(name):
                    yield node.lineno, name
                words = re.findall(r"[^\W_]+", ast.get_docstring(node) or "")
                if words and words[0].lower() in QUESTIONS:
                    yield node.body[0].lineno, " ".join(words[:4])


def is_listed(name: str) -> bool:
    """Tell whether a whole name is a listed word."""
    return name.strip("_").lower() in RIDDLES


def main() -> int:
    """Print the number of places, and each of them where they are too many; 1 then."""
    folders = ("liftcore", "service", "tests", "examples")
    files = [file for folder in folders for file in (ROOT / folder).rglob("*.py")]
    places = [
        f"{file.relative_to(ROOT)}:{line} {words}"
        for file in sorted(files)
        for line, words in listed_places(file.read_text("utf-8"))
    ]
    is_above = len(places) > MOST_PLACES
    if is_above:
        print(*places, "take nouns of the field and verbs with objects: CONTRIBUTING.md", sep="\n")
    print(f"{len(places)} names and docstrings that are riddles, at most {MOST_PLACES} may be")
    return is_above


if __name__ == "__main__":
    sys.exit(main())
