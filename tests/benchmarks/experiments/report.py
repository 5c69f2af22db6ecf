"""One page of all experiments: the tables and plots of the JSON files of a folder.

``python -m tests.benchmarks.experiments.report docs/experiments`` writes ``docs/experiments.md``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.errors import InvalidInput
from liftcore.evaluate.hardware import machine_line
from liftcore.io.whole_file import whole_file
from tests.benchmarks.experiments.run import table_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

HEAD = """# Experiments

What the paper measured, measured here: each section names its command, date and hardware. Figures of another scene or
machine will differ; run the command on yours. This page is made from the JSON files beside the plots by
`python -m tests.benchmarks.experiments.report docs/experiments`.
"""


def page_of(folder: Path) -> str:
    """The page, as Markdown that links to the plots of ``folder`` from its parent.

    Raises:
        InvalidInput: the folder holds no experiment.
    """
    documents = [(file, json.loads(file.read_text())) for file in sorted(folder.glob("*.json"))]
    if not documents:
        raise InvalidInput("folder", expected="JSON files of experiments", got=str(folder))
    return HEAD + "".join(f"\n{line}" for file, document in documents for line in _section(file, document)) + "\n"


def _section(file: Path, document: Mapping[str, Any]) -> Iterator[str]:
    machine = machine_line(document["hardware"])
    yield f"## {document['title']}: {document['scene']}\n"
    taken = f"{document['date']}, {document['seconds']:.0f} s; {machine}"
    yield f"After {document['source']}. `{document['command']}`, {taken}.\n"
    if document.get("note"):
        yield f"{document['note']}\n"
    yield from table_of(document)
    yield f"\n![{document['title']}]({file.parent.name}/{file.stem}.png)\n"


def main() -> None:
    """Write the page beside the folder."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.experiments.report", description=__doc__)
    parser.add_argument("folder", type=Path, metavar="DIR", help="where the JSON files and plots are")
    folder = parser.parse_args().folder
    with whole_file(folder.with_suffix(".md")) as handle:
        handle.write(page_of(folder).encode())


if __name__ == "__main__":
    main()
