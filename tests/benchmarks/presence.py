"""Presence of objects: the answers for words of objects in a scene, and for words of absent objects.

    python -m tests.benchmarks.presence DIR [--features NAME ...] [--presets NAME ...] [--strides N ...] [--json]

``DIR`` is `tabletop`; its table's words are the references. A row is a lift. ``missed`` are present classes that are
called absent, ``lowest`` the least presence of one, ``nothing`` the share of 200 absent words, drawn from the table
with a seed, that select nothing, and ``known without`` the same two with every fourth word as references, where
a word has no vector of its own among them. ``--still-life`` asks the demo's scene in sentences, with the words that
the encoder makes itself.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from liftcore.query.presence import References, estimate_presence, references_of
from liftcore.query.scene import Scene
from liftcore.query.scores import cosines
from liftcore.text import open_encoder
from liftcore.text.table import TableEncoder
from tests.benchmarks.base import PACKS, command_line, print_rows, read_pack
from tests.benchmarks.consensus import still_life_scene
from tests.benchmarks.tabletop import tabletop

PRESETS = ("default", "row-sum", "tikhonov")
ABSENT = 200
PRESENT = ("the mug", "a cup", "something to drink coffee from", "fresh fruit", "an apple", "a banana",
           "reading light", "a novel", "a plant", "tableware")  # fmt: skip
NOT_THERE = ("a sofa", "a dog", "a car", "a guitar", "a bicycle", "a shoe", "an elephant", "an airplane", "a laptop",
             "a hammer", "a person", "a television", "a newspaper", "a knife", "a musical instrument", "a pet",
             "something to wear", "a place to sleep", "a penguin", "a bus")  # fmt: skip


def presences(scene: Scene, vectors: np.ndarray, references: References) -> np.ndarray:
    """[n] f64, the presence of words with these vectors [n, F]."""
    scores = np.ascontiguousarray(cosines(scene.features, scene.norms, vectors).T)
    answers = (
        estimate_presence(scene, "", vector, row, references) for vector, row in zip(vectors, scores, strict=True)
    )
    return np.array([answer.presence for answer in answers])


def figures(present: np.ndarray, absent: np.ndarray) -> dict[str, Any]:
    """Of the presence of things that are there, and of others."""
    false_absent, true_absent = int((present < 0.5).sum()), float((absent < 0.5).mean())
    return {"missed": false_absent, "lowest": float(present.min()), "nothing": true_absent}


def measured(scene: Scene, table: TableEncoder, present: Sequence[int]) -> dict[str, Any]:
    """A row, of the table's words at these rows."""
    other_rows = np.setdiff1d(np.arange(len(table.words)), present)
    absent = np.random.default_rng(0).choice(other_rows, ABSENT, replace=False)
    vectors = table.embeddings[[*present, *absent]]
    row: dict[str, Any] = {}
    all_rows = np.arange(len(table.words))
    for name, rows in (("", all_rows), (" without", np.setdiff1d(all_rows[::4], [*present, *absent]))):
        references = References(tuple(table.words[k] for k in rows), table.embeddings[rows])
        presence = presences(scene, vectors, references)
        row |= {
            key + name: value for key, value in figures(presence[: len(present)], presence[len(present) :]).items()
        }
    return row


def tabletop_rows(
    folder: Path, packs: Iterable[str], presets: Sequence[str], strides: Sequence[int]
) -> Iterator[dict[str, Any]]:
    """One row a lift of the tabletop scene."""
    truth, table = tabletop(folder), TableEncoder.open(folder / "text_table.safetensors")
    present = [int(np.argmax(table.embeddings @ row)) for row in truth.classes.numpy()]
    for pack in packs:
        for stride, preset in product(strides if pack != "grids" else (1,), presets):
            lifted = truth.lift(read_pack(folder, pack, stride), preset=preset)
            head = {"scene": f"{pack}, {len(lifted.views)} views", "preset": preset}
            yield head | measured(truth.open_scene(lifted), table, present)


def still_life_rows(presets: Iterable[str]) -> Iterator[dict[str, Any]]:
    """The demo's scene with its usual and with hard mistakes, asked in sentences."""
    encoder = open_encoder("minilm")
    references = references_of(encoder, "minilm")
    assert isinstance(references, References)
    for seed, kind in enumerate(("usual", "hard"), start=7):
        truth, views = still_life_scene(kind, seed)
        for preset in presets:
            scene = truth.open_scene(truth.lift(views, preset=preset))
            present, absent = (presences(scene, encoder.encode(words), references) for words in (PRESENT, NOT_THERE))
            wrong = [word for word, presence in zip(PRESENT, present, strict=True) if presence < 0.5]
            wrong += [word for word, presence in zip(NOT_THERE, absent, strict=True) if presence >= 0.5]
            head = {"scene": f"still life, {kind}", "preset": preset}
            yield head | figures(present, absent) | {"wrong": ", ".join(wrong)}


def main() -> None:
    """Print the table, or one JSON object."""
    parser = command_line(
        "tests.benchmarks.presence",
        __doc__,
        ("folder", {"type": Path}),
        ("--still-life", {"action": "store_true", "help": "the demo's scene too"}),
        ("--features", {"nargs": "*", "default": PACKS, "choices": PACKS}),
        ("--presets", {"nargs": "+", "default": PRESETS, "metavar": "NAME"}),
        ("--strides", {"nargs": "+", "type": int, "default": (1, 2, 4)}),
    )
    options = parser.parse_args()
    rows = list(tabletop_rows(options.folder, options.features, options.presets, options.strides))
    rows += still_life_rows(options.presets) if options.still_life else []
    print_rows(rows, as_json=options.json)


if __name__ == "__main__":
    main()
