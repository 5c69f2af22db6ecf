"""Gains and costs of the smoothness of features: all its tables in docs/results.md.

    python -m tests.benchmarks.smoothness DATA [--tables NAME ...] [--only TEXT] [--into FILE] [--json]

``DATA`` holds ``tabletop`` and ``plush``. A cell is splat accuracy / argmax mIoU / the worst class's IoU
(`tests.benchmarks.tabletop`); columns are lambdas, and ``chosen`` is the one of ``auto``. ``--into`` keeps a row a
line as soon as it is measured, and a row that is there is not measured again: stop whenever you like, and go on.

``strengths``   packs of tabletop with 4 to 52 views, and mistakes of seeds of their own; in their own colours, and
                with one colour for all splats
``generated``   the tests' still life and small things, with four kinds of mistakes, also in random colours. Words are
                random unit vectors of 128 channels
``edges``       the column ``4, no edges`` of both: what places and colours do alone, without the edges of masks
``factors``     reweighting's parts, alone and together, each without smoothness, with 4 and with the chosen one
``answers``     questions (as ``--alone`` of `tests.benchmarks.thresholds` has them, and 50 words for what is not
                there), boxes (`tests.benchmarks.objects`) and mIoU of ``segment``, off and with ``auto``
``aggregation`` accuracy with aggregation, likewise
``fidelity``    ``plush``: the mean cosine about the maps' mean of rendered features with the maps of other views

A scene is lifted once, and the step is taken by each lambda on the scores of the classes, which are sums of channels:
the step is linear, but for values that leave the range of a channel.
"""

import json
import zlib
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import cosine_similarity

import liftcore as lc
from liftcore.evaluate.accuracy import class_ious
from liftcore.lifting import in_memory
from liftcore.query.ask import ask
from liftcore.query.segment import value_map
from liftcore.scene.cameras import Camera
from liftcore.scene.harmonics import SH_C0
from liftcore.scene.neighbours import SplatGraph
from liftcore.solve.codebook import Codebook
from liftcore.solve.mask_edges import weaken_edges
from liftcore.solve.smooth import smooth
from liftcore.solve.smooth_by_halves import STRENGTHS, SmoothnessChoice, choose_smoothness
from liftcore.text.table import TableEncoder
from liftcore.values.region_weights import RegionWeights
from liftcore.values.views import NO_LABEL, FeatureGrid, ViewFeatures
from tests.benchmarks.base import command_line, print_rows, read_pack, read_scene, table_of
from tests.benchmarks.consensus import still_life_scene, with_mistakes
from tests.benchmarks.objects import measure_boxes, things_of
from tests.benchmarks.tabletop import Figures, Truth, tabletop
from tests.benchmarks.thresholds import measure_alone
from tests.still_life.objects import small_things

TABLES = ("strengths", "generated", "factors", "answers", "aggregation", "fidelity")
STEPS = ("off", "auto")
ABSENT = 50  # words for what is not there
COLOURS = ("own", "one", "random")
STRONG = 4.0
GENERATED = {"still life": None, "small things": small_things()}
LAMBDAS = ("0", "0.3", "1", "4", "auto")  # of fidelity
TEST_MAPS = "grids_test"
FULL = 0.5  # of a ray that the scene takes, for its cell to be judged
CHANNELS = 64  # rendered at a time
FACTORS: dict[str, dict[str, Any]] = {
    "row-sum": {"robust_steps": 0},
    "robust step": {"preset": "row-sum", "robust_steps": 1},
    "and reliability": {"consensus": False},
    "and consensus (`default`)": {},
}

FILE_COLUMNS = ("table", "name")  # columns of the file alone
Row = dict[str, Any]


class RandomWords:
    """A unit vector for each word, which its letters draw; all share a little, as those of text encoders do."""

    name, channels = "random words", 128

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        """[n, 128] f32."""
        samples = [np.random.default_rng(zlib.crc32(text.encode())).standard_normal(self.channels) for text in texts]
        common = np.random.default_rng(0).standard_normal(self.channels)
        vectors = np.array([sample / np.linalg.norm(sample) for sample in samples]) + 0.3 * common / np.linalg.norm(
            common
        )
        return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


@dataclass(frozen=True)
class StepInputs:
    """The inputs of the smoothing step in a lift."""

    truth: Truth
    W: RegionWeights
    levels: np.ndarray  # [M] i8
    codebook: Codebook
    total_weight: Tensor  # [P] f32
    confidence: Tensor | None  # [P] f32
    visible: Tensor  # [P] bool
    scores: Tensor  # [P, K] f32, of X with the classes
    params: lc.CompositingParams

    @classmethod
    def of(cls, truth: Truth, views: Mapping[str, ViewFeatures], **settings: Any) -> "StepInputs":
        """Lift, and hold what the step is called with."""
        parts = dict[str, Any]()

        def weaken(graph: SplatGraph, W: RegionWeights, levels: np.ndarray, *_: Any) -> tuple[SplatGraph, float]:
            parts.update(W=W, levels=levels)
            return graph, 0.0

        def choose(_: RegionWeights, codebook: Codebook, *__: Any, **___: Any) -> SmoothnessChoice:
            parts.update(codebook=codebook)
            return SmoothnessChoice(0.0, {})

        def hold(X: Tensor, *arguments: Any, **_: Any) -> tuple[Tensor, dict[str, Any]]:
            total_weight, confidence, visible = arguments[1:4]
            scores = torch.cat([rows.float() @ truth.classes.T for rows in X.split(1 << 14)])
            parts.update(total_weight=total_weight, confidence=confidence, visible=visible, scores=scores)
            return X, {"smoothness": 0.0}

        with mock.patch.multiple(in_memory, weaken_edges=weaken, choose_smoothness=choose, smooth=hold):
            lifted = truth.lift(views, smoothness="auto", progress=False, **settings)
        return cls(truth, params=lifted.settings.render_params, **parts)

    def graph(self, colours: str) -> SplatGraph:
        """Places and colours of the splats."""
        return SplatGraph.of(coloured(self.truth.raster.splats, colours))

    def choose(self, graph: SplatGraph) -> float:
        """Choose the strength as ``auto`` does."""
        return choose_smoothness(self.W, self.codebook, graph, self.confidence).smoothness

    def measure_steps(self, steps: Mapping[str, tuple[SplatGraph, float]]) -> dict[str, str]:
        """Figures after each step, a graph with a lambda."""
        tables = [
            smooth(self.scores.clone(), graph, self.total_weight, self.confidence, self.visible, strength)[0]
            for graph, strength in steps.values()
        ]
        figures = self.truth.judge_each(tables, self.params)
        return {name: cell(figure) for name, figure in zip(steps, figures, strict=True)}


def cell(figures: Figures) -> str:
    """Accuracy / mIoU / worst class."""
    return " / ".join(f"{value:.3f}".removeprefix("0") for value in vars(figures).values())


@dataclass(frozen=True)
class Case:
    """A scene with features, and the rows that it gives."""

    table: str
    name: str
    open: Callable[[], tuple[Truth, Mapping[str, ViewFeatures]]]
    colours: Sequence[str] = ("own",)
    folder: Path | None = None  # of tabletop, whose words are asked
    settings: Mapping[str, Any] = field(default_factory=dict)

    def row_names(self) -> list[tuple[str, str]]:
        """Name and kind (colours, or a factor) of each row."""
        kinds = {"factors": tuple(FACTORS), "answers": STEPS, "aggregation": STEPS}
        return [(self.name, kind) for kind in kinds.get(self.table, self.colours)]

    def measure(self, missing: Sequence[str]) -> Iterator[Row]:
        """The rows of these kinds."""
        truth, views = self.open()
        for kind, figures in self._figures(truth, views, missing):
            head = {"table": self.table, "features": f"{self.name}, {len(views)} views", "name": self.name}
            yield {**head, "kind": kind, **figures}

    def _figures(
        self, truth: Truth, views: Mapping[str, ViewFeatures], kinds: Sequence[str]
    ) -> Iterator[tuple[str, dict[str, Any]]]:
        if self.table == "factors":
            yield from ((kind, with_factor(StepInputs.of(truth, views, **FACTORS[kind]))) for kind in kinds)
        elif self.table == "answers":
            lifts: Mapping[str, lc.LiftResult] = dict(zip(STEPS, unsmoothed_and_smoothed(truth, views), strict=True))
            assert self.folder is not None
            table = TableEncoder.open(self.folder / "text_table.safetensors")
            yield from ((kind, answers(truth, table, lifts[kind])) for kind in kinds)
        elif self.table == "aggregation":
            yield from ((kind, with_aggregation(truth, views, kind)) for kind in kinds)
        else:
            inputs = StepInputs.of(truth, views, **self.settings)
            yield from ((kind, strengths(inputs, kind)) for kind in kinds)


def strengths(inputs: StepInputs, colours: str) -> dict[str, Any]:
    """Figures by lambda, without the edges of masks, and the lambda that was chosen."""
    full_graph = inputs.graph(colours)
    graph, weakened = weaken_edges(full_graph, inputs.W, inputs.levels)
    steps = {f"{strength:g}": (graph, strength) for strength in (0.0, *STRENGTHS)}
    steps |= {"4, no edges": (full_graph, STRONG)} if weakened else {}
    return {"chosen": inputs.choose(graph), **inputs.measure_steps(steps)}


def with_factor(inputs: StepInputs) -> dict[str, Any]:
    """Figures without smoothness, with 4 and with the chosen lambda."""
    graph, _ = weaken_edges(inputs.graph("own"), inputs.W, inputs.levels)
    choice = inputs.choose(graph)
    steps = {"0": (graph, 0.0), "4": (graph, STRONG), "auto": (graph, choice)}
    return {"chosen": choice, **inputs.measure_steps(steps)}


def unsmoothed_and_smoothed(truth: Truth, views: Mapping[str, ViewFeatures]) -> tuple[lc.LiftResult, lc.LiftResult]:
    """A lift before the step, and after it with ``auto``."""
    before = list[Tensor]()

    def step(X: Tensor, *arguments: Any, **keywords: Any) -> tuple[Tensor, dict[str, Any]]:
        before.append(X.clone())
        return smooth(X, *arguments, **keywords)

    with mock.patch.object(in_memory, "smooth", step):
        lifted = truth.lift(views, smoothness="auto", progress=False)
    return replace(lifted, features=before[0]), lifted


def answers(truth: Truth, table: TableEncoder, lifted: lc.LiftResult) -> dict[str, Any]:
    """Measure answers: masks of single words, words of absent objects, boxes, and the map of all words."""
    scene = truth.open_scene(lifted)
    other_words = [word for word in table.words if word not in truth.words]
    absent = np.random.default_rng(0).choice(other_words, ABSENT, replace=False).tolist()
    single_queries = measure_alone(scene, truth, table, absent)
    of_things = {number: ask(scene, truth.words[number], table) for number in things_of(truth)}
    boxes = measure_boxes(scene, of_things, truth.objects.numpy())
    segmentation = scene.segment(truth.words, encoder=table)
    rows = [0, *(1 + truth.words.index(label.word) for label in segmentation.named_words)]
    classes = np.array(rows, np.int32)[segmentation.values]
    truth_labels = torch.stack(list(truth.held_out.values()))
    maps = [torch.from_numpy(value_map(scene, classes, view)).long() - 1 for view in truth.held_out]
    best = torch.where(truth_labels < 0, NO_LABEL, torch.stack(maps))
    return {
        "masks": f"{single_queries['mean']:.3f}, {single_queries['worst']:.2f}",
        "called absent": single_queries["called absent"],
        "absent words select nothing": single_queries["absent words select nothing"],
        "one object": boxes["one"],
        "boxes": f"{boxes['box']:.3f}, {boxes['worst']:.2f}",
        "segment": float(class_ious(best, truth_labels, len(truth.words)).nanmean()),
    }


def with_aggregation(truth: Truth, views: Mapping[str, ViewFeatures], step: str) -> dict[str, Any]:
    """Figures of a lift with aggregation."""
    strength = "auto" if step == "auto" else 0
    lifted = truth.lift(views, aggregation=True, smoothness=strength, progress=False)
    smoothness = lifted.diagnostics.get("smoothing", {}).get("smoothness", 0.0)
    return {"chosen": smoothness, "aggregated": cell(truth.evaluate(lifted))}


def cases(data: Path, tables: Sequence[str]) -> Iterator[Case]:
    """All scenes of the tables, which open when they are measured."""
    folder = data / "tabletop"
    scenes = list[Truth]()

    def truth() -> Truth:
        scenes.append(scenes[0] if scenes else tabletop(folder))
        return scenes[0]

    def pack(name: str, stride: int) -> Callable[[], tuple[Truth, Mapping[str, ViewFeatures]]]:
        return lambda: (truth(), read_pack(folder, name, stride))

    def mistaken(kind: str, seed: int) -> tuple[Truth, Mapping[str, ViewFeatures]]:
        return truth(), with_mistakes(folder, kind, seed)

    for name, file, stride, colours in (
        ("grids", "grids", 1, COLOURS[:2]), ("grids", "grids", 3, COLOURS[:1]), ("grids", "grids", 5, COLOURS[:1]),
        *(("hard", "features_hard", stride, COLOURS[: 2 if stride < 5 else 1]) for stride in (13, 7, 4, 2, 1)),
        *(("noisy", "features", stride, COLOURS[: 2 if stride in (1, 4) else 1]) for stride in (13, 7, 4, 1)),
    ):  # fmt: skip
        if "strengths" in tables:
            yield Case("strengths", f"{name}, every {stride}", pack(file, stride), colours)
    for kind, seed in product(("hard", "usual"), (7, 8)):
        if "strengths" in tables:
            yield Case("strengths", f"{kind} {seed}", partial(mistaken, kind, seed))
    for scene, (kind, seed) in product(GENERATED, (("usual", 7), ("hard", 7), ("exact", 7), ("cone", 8))):
        if "generated" in tables:
            yield Case("generated", f"{scene}, {kind} {seed}", partial(generated, scene, kind, seed), COLOURS)
            if kind in ("usual", "hard"):
                name = f"{scene}, {kind} {seed}, masks of things alone"
                yield Case("generated", name, partial(generated, scene, kind, seed), settings={"levels": 0})
    for name, file, stride in (
        ("hard", "features_hard", 1), ("hard", "features_hard", 4), ("noisy", "features", 1),
        ("noisy", "features", 4), ("grids", "grids", 1),
    ):  # fmt: skip
        if "factors" in tables:
            yield Case("factors", f"{name}, every {stride}", pack(file, stride))
    for table, (name, file, stride) in product(
        ("answers", "aggregation"),
        (("hard", "features_hard", 4), ("grids", "grids", 1), ("hard", "features_hard", 1), ("noisy", "features", 1)),
    ):
        if table in tables:
            yield Case(table, f"{name}, every {stride}", pack(file, stride), folder=folder)
    for scene in GENERATED if "factors" in tables else ():
        yield Case("factors", f"{scene}, hard 7", partial(generated, scene, "hard", 7))


def generated(scene: str, kind: str, seed: int) -> tuple[Truth, Mapping[str, ViewFeatures]]:
    """A scene of the tests with mistakes."""
    return still_life_scene(kind, seed, GENERATED[scene], RandomWords())


def coloured(splats: lc.Splats, kind: str) -> lc.Splats:
    """The splats with their own colours, one colour, or a random colour each."""
    if kind == "own":
        return splats
    shape, generator = (splats.count, 1, 3), torch.Generator().manual_seed(1)
    colours = torch.zeros(shape) if kind == "one" else (torch.rand(shape, generator=generator) - 0.5) / SH_C0
    return replace(splats, sh=colours)


def fidelity_rows(folder: Path, missing: Sequence[tuple[str, str]]) -> Iterator[Row]:
    """A row for each stride and lambda: fidelity of a lift to maps of other views."""
    splats, cameras = read_scene(folder)
    maps = {name: grid for name, grid in read_pack(folder, TEST_MAPS).items() if isinstance(grid, FeatureGrid)}
    mean = torch.stack([grid_view.grid.float().mean(dim=(0, 1)) for grid_view in maps.values()]).mean(dim=0)

    def cosines(lifted: lc.LiftResult, name: str) -> torch.Tensor:
        grid = maps[name].grid.float()
        height, width, channels = grid.shape
        camera = at_cells(cameras[name], width, height)
        parts = [lifted.features[:, first : first + CHANNELS].float() for first in range(0, channels, CHANNELS)]
        rendered = torch.cat([lc.render(splats, camera, part) for part in parts], dim=2)
        opacity = lc.render(splats, camera, torch.ones(splats.count, 1))[:, :, 0]
        rendered = rendered / opacity.clamp_min(FULL)[:, :, None]
        return cosine_similarity(rendered - mean, grid - mean, dim=2)[opacity >= FULL]

    for name, smoothness in missing:
        views = read_pack(folder, "grids", int(name.rsplit(" ", 1)[1]))
        strength = smoothness if smoothness == "auto" else float(smoothness)
        result = lc.lift(splats, cameras, views, diagnostic_rays=0, smoothness=strength, progress=False).cpu()
        fidelity = float(torch.cat([cosines(result, view) for view in maps]).mean())
        selected_strength = result.diagnostics.get("smoothing", {}).get("smoothness", 0.0)
        head = {"table": "fidelity", "features": f"{name}, {len(views)} views", "name": name, "kind": smoothness}
        yield {**head, "chosen": selected_strength, "fidelity": fidelity}


def at_cells(camera: Camera, width: int, height: int) -> Camera:
    """The camera with one pixel a cell of a map of its image."""
    K = camera.K.copy()
    K[0] *= width / camera.width
    K[1] *= height / camera.height
    return lc.Camera(camera.viewmat, K, width, height, name=camera.name)


class Rows:
    """Rows that were measured, a line of JSON each, in a file where one is named."""

    def __init__(self, file: Path | None) -> None:
        self.file = file
        lines = file.read_text().splitlines() if file and file.is_file() else []
        self.rows: list[Row] = [json.loads(line) for line in lines]

    def __contains__(self, key: tuple[str, str, str]) -> bool:
        return any((row["table"], row["name"], row["kind"]) == key for row in self.rows)

    def add(self, row: Row) -> None:
        """Hold a row, and write it."""
        self.rows.append(row)
        if self.file:
            with self.file.open("a") as lines:
                lines.write(json.dumps(row) + "\n")


def measure(options: Namespace, rows: Rows) -> None:
    """Measure what is not there."""
    for case in cases(options.data, options.tables):
        missing = [kind for name, kind in case.row_names() if (case.table, name, kind) not in rows]
        if missing and options.only in case.name:
            for row in case.measure(missing):
                rows.add(row)
    if "fidelity" in options.tables:
        requested = product(("dense, every 1", "dense, every 4"), LAMBDAS)
        missing = [key for key in requested if ("fidelity", *key) not in rows and options.only in key[0]]
        for row in fidelity_rows(options.data / "plush", missing) if missing else ():
            rows.add(row)


def main() -> None:
    """Print the tables, or one JSON object."""
    parser = command_line(
        "tests.benchmarks.smoothness",
        __doc__,
        ("data", {"type": Path}),
        ("--tables", {"nargs": "+", "default": TABLES, "choices": TABLES}),
        ("--only", {"default": "", "metavar": "TEXT", "help": "scenes whose name has it, as 'hard, every 4'"}),
        ("--into", {"type": Path, "metavar": "FILE", "help": "rows that are measured; those in it are not again"}),
    )
    options = parser.parse_args()
    rows = Rows(options.into)
    measure(options, rows)
    tables = [[row for row in rows.rows if row["table"] == table] for table in options.tables]
    columns = [list(dict.fromkeys(key for row in part for key in row if key not in FILE_COLUMNS)) for part in tables]
    if not options.json:
        for part, names in list(zip(tables, columns, strict=True))[:-1]:
            print(table_of(part, names) + "\n")
    print_rows(rows.rows if options.json else tables[-1], as_json=options.json, columns=columns[-1])


if __name__ == "__main__":
    main()
