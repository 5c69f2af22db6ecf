"""A lift: features on splats, their support, and the metadata of how they were made.

Its metadata are read without torch, so that a query of a file does not load it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Self

from pydantic import AfterValidator, BaseModel, ConfigDict

from liftcore.errors import InvalidSplats
from liftcore.runtime.one_line import one_line
from liftcore.scene.origin import FILE_ORIGIN, Origin
from liftcore.scene.views import composed
from liftcore.scene.world import UNKNOWN, WorldFrame
from liftcore.text.table import TableEncoder, own_words
from liftcore.values.lift_file import FORMAT, NODE_TENSORS, SCHEMA
from liftcore.values.settings import LiftSettings

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from liftcore.scene.similarity import Numbers
    from liftcore.scene.splats import Rows, Splats


class InputFile(BaseModel):
    """Path of an input, and its digest."""

    model_config = ConfigDict(frozen=True)

    path: str  # absolute, at lift time; empty for values that came from no file
    sha256: str  # of the file's bytes; of the sorted (name, digest) lines for a folder


NO_FILE = InputFile(path="", sha256="")
Landmark = tuple[int, float, float, float]  # a row, and its splat's position in the world frame, scene units
LANDMARKS = 32  # evenly spaced over the rows
NEAR = 0.01  # of the landmarks' extent: copies that are quantised, or trained a little more, lie nearer
DIGITS = 9  # of a coordinate


def landmarks_of(splats: Splats) -> tuple[Landmark, ...]:
    """Return the rows and positions of LANDMARKS splats, evenly spaced over the rows."""
    rows = sorted({round(k * (splats.count - 1) / (LANDMARKS - 1)) for k in range(LANDMARKS)})
    places = [[float(f"{x:.{DIGITS}g}") for x in place] for place in splats.positions(rows).tolist()]
    return tuple((row, x, y, z) for row, (x, y, z) in zip(rows, places, strict=True))


class LiftMetadata(BaseModel):
    """Settings, inputs and measurements of a lift."""

    model_config = ConfigDict(frozen=True)

    format: str = FORMAT
    version: str
    settings: LiftSettings
    splats: InputFile = NO_FILE
    cameras: InputFile = NO_FILE
    features: tuple[InputFile, ...] = ()
    encoder: str = ""  # the 2D encoder's name as the pack tells it; "" when unknown
    text_space: str = ""  # the text encoder that shares the space; "" not named, "none" when there is none
    words: tuple[str, ...] = ()  # that its packs brought: it is asked in these without an encoder
    views: tuple[Annotated[str, AfterValidator(composed)], ...]  # the views that were lifted
    poses: str = ""  # of their cameras (`liftcore.values.lift_file.poses_of`); "" after a transform
    origin: Origin = FILE_ORIGIN  # of the splats (`Splats.origin`), and of the positions in ``.splat`` and ``.spz``
    world: WorldFrame = UNKNOWN  # of the splats: as their file, else that of the cameras says it, or somebody later
    landmarks: tuple[Landmark, ...] = ()  # positions of some splats, to verify their rows
    diagnostics: dict[str, Any]
    timings: dict[str, float]  # seconds a stage


@dataclass(frozen=True)
class Lift:
    """X and what supports it, one row a splat, in the splats' order."""

    rows: Tensor
    """[P, F] f16 or f32, zero without a feature; of a lift as codes [K, F], the rows that ``code`` refers to"""
    total_weight: Tensor
    """[P] f32, sum of plain weights w over the feature views, each ray once"""
    has_feature: Tensor
    """[P] bool, whether any labelled ray reached the splat"""
    metadata: LiftMetadata
    confidence: Tensor | None = None
    """[P] f32 in 0..1, how far views say the same; None: not reweighted"""
    cluster: Tensor | None = None
    """[P] i32, -1 = in no cluster; None without aggregation"""
    cluster_features: Tensor | None = None
    """[K, F] like features; a zero row: its splats keep their own"""
    embeddings: Tensor | None = None
    """[n, F] f32, the unit vectors of the metadata's words; None: it has none"""
    object: Tensor | None = None
    """[P] i32, -1 = of no object; None: objects were not looked for"""
    object_views: Tensor | None = None
    """[N, 5] i32, places in ``views`` that show most of each, -1 after the last"""
    node: Tensor | None = None
    """[P] i32, the smallest of objects, parts and groups that a splat is of; -1: of none; None: no tree was made"""
    node_parents: Tensor | None = None
    """[T] i32, the node that each node is a part of, -1 for none; the first N nodes are the objects"""
    node_views: Tensor | None = None
    """[T, 5] i32, as ``object_views``"""
    node_confidence: Tensor | None = None
    """[T] f32 in 0..1, of the views that see a node those that have a mask of the whole"""
    node_features: Tensor | None = None
    """[T, F] f16, the unit mean of its own masks' unit vectors, without those of its parts; zero where they cancel"""
    code: Tensor | None = None
    """[P] u16, the row of ``rows`` of each splat, 0 = none, which is zero; None: a row a splat"""

    def __repr__(self) -> str:
        splats, channels = len(self), self.rows.shape[1]
        counts = f"{splats} splats", f"{channels} channels from {len(self.views)} views"
        return one_line(self, *counts, f"preset={str(self.settings.preset)!r}", f"on {self.rows.device}")

    @property
    def features(self) -> Tensor:
        """[P, F] f16 or f32, zero without a feature. Of a lift as codes a new tensor each time."""
        return self.rows if self.code is None else self.rows[self.code.long()]

    @property
    def columns(self) -> dict[str, Tensor]:
        """Its tensors with a row a splat, by their names."""
        names = [name for name, (_, axes) in SCHEMA.items() if axes == "P"] + ["rows"] * (self.code is None)
        return {name: column for name in names if (column := getattr(self, name)) is not None}

    @property
    def settings(self) -> LiftSettings:
        """Settings of the lift."""
        return self.metadata.settings

    @property
    def views(self) -> tuple[str, ...]:
        """The names of the views that were lifted, in the order of the sums."""
        return self.metadata.views

    @property
    def diagnostics(self) -> dict[str, Any]:
        """Measurements of the lift (residual, bound, row sums, warnings, plan), as plain numbers."""
        return self.metadata.diagnostics

    @property
    def table(self) -> TableEncoder | None:
        """The words that its packs brought, with their vectors (`.words`, `.encode(words)`); None without any."""
        return own_words(self.metadata.words, None if self.embeddings is None else self.embeddings.cpu().numpy())

    def __len__(self) -> int:
        """P, the number of rows."""
        return len(self.total_weight)

    def __getitem__(self, keep: Rows) -> Self:
        """Return the lift of the splats of a mask [P], a slice or row numbers [n], as ``splats[keep]`` has them.

        All columns follow. Objects and clusters of which no splat is left go, and the others are numbered anew in
        their order. It remembers no file of splats, as a file's rows are others. Diagnostics stay those of the whole.
        """
        from liftcore.scene.splats import chosen_rows

        rows = chosen_rows(keep, len(self)).to(self.rows.device)
        columns = {name: column[rows] for name, column in self.columns.items()}
        for labels, table in (("cluster", "cluster_features"), ("object", "object_views")):
            if labels in columns and (values := getattr(self, table)) is not None:
                columns[labels], columns[table] = renumbered(columns[labels], values)
        if self.node is not None:
            tree = {name: getattr(self, name) for name in NODE_TENSORS}
            columns |= cropped_tree(tree | {"node": columns["node"]})
        places = {row: place for row, *place in self.metadata.landmarks}
        row_numbers = enumerate(rows.tolist())
        landmarks = tuple((new, *places[old]) for new, old in row_numbers if old in places)
        full_count = self.diagnostics.get("cropped_from", len(self))
        changes = {
            "splats": NO_FILE,
            "landmarks": landmarks,
            "diagnostics": self.diagnostics | {"cropped_from": full_count},
        }
        return replace(self, **columns, metadata=self.metadata.model_copy(update=changes))

    def transformed(self, matrix: Numbers) -> Self:
        """Return the lift of splats that were moved alike (`Splats.transformed`), ``p' = scale R p + translation``.

        Features, total weight and objects know no frame and stay. What it remembers of places moves along; it forgets
        the files of its splats and cameras, which are in the frame of before.
        """
        import numpy as np

        from liftcore.scene.similarity import Similarity

        move, metadata = Similarity.of(matrix), self.metadata
        rows, places = [row for row, *_ in metadata.landmarks], [place for _, *place in metadata.landmarks]
        positions = move.points(np.array(places).reshape(-1, 3)).tolist()
        changes = {
            "splats": NO_FILE,
            "cameras": NO_FILE,
            "poses": "",
            "origin": tuple(move.points(np.array([metadata.origin]))[0].tolist())
            if any(metadata.origin)
            else FILE_ORIGIN,
            "landmarks": tuple((row, *place) for row, place in zip(rows, positions, strict=True)),
            "world": metadata.world.transformed(move),
        }
        return replace(self, metadata=metadata.model_copy(update=changes))

    def with_world(self, world: WorldFrame) -> Self:
        """Return the lift with what is said of its frame; what ``world`` does not know stays as it is."""
        changes = {"world": world.known_or(self.metadata.world)}
        return replace(self, metadata=self.metadata.model_copy(update=changes))

    def require_splats(self, splats: Splats) -> None:
        """Refuse splats that are not those of the lift, row for row, by their number and where some of them lie.

        Copies that were quantised pass: half of the landmarks must lie within NEAR of their extent.
        """
        from liftcore.scene.splats import Splats

        expected = f"the {len(self)} Splats that were lifted"
        if not isinstance(splats, Splats):
            got, hint = f"{type(splats).__name__} {splats!r}"[:80], "read_splats(path) makes them of a file"
            raise InvalidSplats("splats", expected=expected, got=got, hint=hint)
        if splats.count != len(self):
            hint = "crop a lift as its splats: result[keep] and splats[keep]"
            raise InvalidSplats("splats", expected=expected, got=f"{splats.count} splats", hint=hint)
        off = _off_landmarks(self.metadata.landmarks, splats)
        if 2 * off > len(self.metadata.landmarks):
            raise InvalidSplats(
                "splats", expected=f"{expected}, row for row",
                got=f"others: {off} of {len(self.metadata.landmarks)} that were compared lie elsewhere",
                hint="give the splats of the lift in their order; splats that were cropped or moved go with "
                "result[keep] and result.transformed(...)",
            )  # fmt: skip

    def to(self, place: torch.device) -> Self:
        """Return the same with its tensors there; where they are, if there is no room for them."""
        from liftcore.runtime.device import out_of_memory

        tensors = {name: part for name, part in vars(self).items() if hasattr(part, "device")}
        if all(part.device == place for part in tensors.values()):
            return self
        try:
            return replace(self, **{name: part.to(place) for name, part in tensors.items()})
        except RuntimeError as error:
            if not out_of_memory(error):
                raise
            return self

    def cpu(self) -> Self:
        """Return the same with its tensors on the CPU."""
        import torch

        return self.to(torch.device("cpu"))


def renumbered(labels: Tensor, table: Tensor) -> tuple[Tensor, Tensor]:
    """Return labels [n] of rows of a table [K, ..], -1 for none, and the table without unused rows."""
    import torch

    present, numbers = torch.unique(labels, return_inverse=True)
    none = int((present < 0).sum())
    return (numbers - none).clamp_min(-1).to(labels.dtype), table[present[none:].long()]


def cropped_tree(tree: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return a tree without the nodes that no splat of its ``node`` [n] is left of."""
    import torch

    node, parents = tree["node"], tree["node_parents"].long()
    present = torch.zeros(len(parents) + 1, dtype=torch.bool, device=node.device)  # the last is of -1
    above = torch.unique(node).long()
    while len(above := above[above >= 0]):
        present[above] = True
        above = parents[above]
    numbers = torch.where(present, present.cumsum(0) - 1, -1).to(node.dtype)
    rows = {name: part[present[:-1]] for name, part in tree.items() if name != "node"}
    return rows | {"node": numbers[node.long()], "node_parents": numbers[parents[present[:-1]]]}


def _off_landmarks(landmarks: tuple[Landmark, ...], splats: Splats) -> int:
    """Count the splats that are not at their landmarks."""
    import numpy as np

    if not landmarks:
        return 0
    places = np.array([place for _, *place in landmarks])
    rows = np.array([row for row, *_ in landmarks])  # of a lift cropped by other means, perhaps beyond the last
    positions = splats.positions(rows.clip(max=splats.count - 1)).astype(np.float64)
    low, high = np.quantile(places, (0.1, 0.9), axis=0)  # floaters decide nothing
    near = NEAR * float((high - low).max()) + float(np.spacing(np.float32(np.abs(places).max())))
    return int((np.abs(positions - places).max(axis=1) > near).sum())
