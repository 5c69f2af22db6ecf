"""From W to X: an engine runs the steps of pieces (`lifting.steps`), whose sums over the scene are added here.

In memory W is one piece. Of a lift in blocks this process holds tables of size M, a few columns of the splats, and
the graph of objects.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from liftcore.lifting import steps
from liftcore.solve.consensus import mean_share
from liftcore.solve.diagnostics import ViewMeasures, measure_samples
from liftcore.solve.directions import RegionDirections
from liftcore.solve.objects import NodeVectors, RegionObjects, add_regions, choose_nodes, number_objects
from liftcore.solve.region_tree import RegionTree, region_tree
from liftcore.solve.reweight import SceneConsistency, median_reliability

if TYPE_CHECKING:
    from liftcore.lifting.engines import Engine
    from liftcore.lifting.pieces import Pieces
    from liftcore.lifting.planning.plan import Plan
    from liftcore.lifting.steps import Step
    from liftcore.runtime.progress import Progress


@dataclass(frozen=True)
class WeightStatistics:
    """Facts about W before any reweighting."""

    plan: Plan  # with the warnings that the first views gave
    levels: np.ndarray  # [M] i8, of each region in its view; -1: a cell of a grid, or regions that are tuples
    entries: int  # of W
    blind: tuple[str, ...]  # views whose rays hit no splat

    @property
    def masks(self) -> bool:
        """True if any view has masks."""
        return bool((self.levels >= 0).any())


@dataclass(frozen=True)
class SplatSupport:
    """Weights and confidence behind X, a value a splat."""

    sums: np.ndarray  # [P] f64, of rows of W before any reweighting
    total_weight: Tensor  # [P] f32, sums of plain weights over all views, each ray once
    confidence: Tensor | None  # [P] f32; None where W was not reweighted


@dataclass
class Algebra:
    """W of a lift, and all that is computed of it, in this order."""

    pieces: Pieces
    engine: Engine
    progress: Progress
    threads: int | None = None
    is_related: bool = False  # True once tuples were made, which objects and consensus share

    def run(self, stage: str, step: Step, count: int) -> None:
        """Run a step for all its pieces, and report progress."""
        for completed, _ in enumerate(self.engine.run(step, self.pieces, count), start=1):
            self.progress(stage, completed, count, "blocks")

    def find_objects(self) -> tuple[RegionObjects, NodeVectors]:
        """Group splats into objects that the masks of many views agree on, and objects into parts.

        Returns:
            The objects, and the mean feature of each node's masks.
        """
        pieces = self.pieces
        self._relate("objects")
        sizes = np.concatenate([pieces.load("relate", number)["sizes"] for number in range(pieces.view_pieces)])
        groups = steps.groups_of(pieces)
        nodes, other_masks = choose_nodes(groups, sizes)
        pieces.save("nodes", None, {"nodes": nodes, "other_masks": other_masks})
        self.run("objects", steps.contain, pieces.view_pieces)
        parts = [pieces.load("contain", number)["container"] for number in range(pieces.view_pieces)]
        tree = region_tree(nodes, groups, np.concatenate(parts), self.threads)
        number = tree.parents.size
        if number and other_masks.size:
            self._label(0, tree)
            tree = add_regions(tree, other_masks, pieces.sums("labels-0"))
        self._label(1, tree)
        labels, total_weight = pieces.column("labels-1", "labels"), pieces.column("rows", "total_weight")
        view_weights = pieces.table("labels-1", (1, number * groups.views)).reshape(number, groups.views)
        objects = number_objects(labels, total_weight, tree, view_weights)
        return objects, NodeVectors.of(pieces.codebook, self._region_totals(), objects)

    def _label(self, turn: int, tree: RegionTree) -> None:
        self.pieces.save(f"tree-{turn}", None, vars(tree))
        self.pieces = replace(self.pieces, turn=turn)
        self.run("objects", steps.label, self.pieces.splat_pieces)

    def _region_totals(self) -> np.ndarray:
        """Return the weight of each region, [M] f64."""
        return self.pieces.table("rows", (1, self.pieces.codebook.regions))[0]

    def _relate(self, stage: str) -> None:
        """Number the tuples of regions to which splats belong, over all views, unless that is done."""
        pieces = self.pieces
        if self.is_related:
            return
        self.run(stage, steps.relate, pieces.view_pieces)
        bases, parents, members = [0], list[np.ndarray](), list[np.ndarray]()
        for number in range(pieces.view_pieces):
            part = pieces.load("relate", number)
            parents.append(np.where(part["parents"] < 0, part["parents"], part["parents"] + np.int32(bases[-1])))
            members.append(part["members"].copy())
            bases.append(bases[-1] + parents[-1].size)
        arrays = {"parents": np.concatenate(parents), "members": np.concatenate(members)}
        pieces.save("tuples", None, arrays | {"bases": np.array(bases[:-1])})
        self.run(stage, steps.join, pieces.splat_pieces)
        self.is_related = True

    def compare_masks(self) -> None:
        """Compute the consensus of masks, for `reweight`."""
        pieces = self.pieces
        self._relate("consensus")
        bounds = np.concatenate([pieces.load("rows", number)["bounds"] for number in range(pieces.splat_pieces)])
        curve = np.stack([bounds.min(axis=0), bounds.max(axis=0)]) if bounds.size else bounds
        pieces.save("curve", None, {"bounds": curve})
        self.run("consensus", steps.share, pieces.view_pieces)
        parts = [pieces.load("share", number)["shares"] for number in range(pieces.view_pieces)]
        share_sum, share_count = np.sum(parts, axis=0)
        pieces.drop("relate", "join")
        self.pieces = replace(pieces, usual_share=mean_share(int(share_sum), int(share_count)))

    def reweight(self, levels_apart: bool) -> float | None:
        """Prepare the factors of W, which `solve` applies; return the median reliability of regions.

        Args:
            levels_apart: True if regions are compared with those of their own level alone.

        Returns:
            None without masks.
        """
        pieces = self.pieces = replace(self.pieces, levels_apart=levels_apart)
        codebook, mask = pieces.codebook, pieces.load("regions")["levels"] >= 0
        entries = sum(pieces.load("rows", number)["region"].size for number in range(pieces.splat_pieces))
        totals = torch.from_numpy(self._region_totals())
        directions = RegionDirections.of(codebook, totals, entries, pieces.settings.robust_directions)
        axes = {} if directions.axes is None else {"axes": directions.axes}
        pieces.save("directions", None, {"mean": directions.mean, "distances": directions.distances, **axes})
        self.run("reweight", steps.compare, pieces.splat_pieces)
        levels = steps.compared_levels(pieces)
        sums = pieces.table("cosines", (2, codebook.regions + int(levels.max(initial=0)) + 1))
        pieces.save("consistency", None, vars(SceneConsistency.of(sums, levels, mask)))
        return median_reliability(sums, mask)

    def solve(self) -> tuple[Tensor, SplatSupport]:
        """Solve for X [P, F] in closed form."""
        pieces, dtype = self.pieces, getattr(torch, self.pieces.settings.dtype)
        if dtype == torch.float16 and not pieces.codebook.fits_float16():
            dtype = torch.float32
        pieces = self.pieces = replace(pieces, dtype=dtype)
        sums, total_weight = pieces.column("rows", "sums"), torch.from_numpy(pieces.column("rows", "total_weight"))
        self.run("solve", steps.solve, pieces.splat_pieces)
        confidence = torch.from_numpy(pieces.column("columns", "confidence")) if pieces.settings.robust else None
        return pieces.features(), SplatSupport(sums, total_weight, confidence)

    def measure(self, X: Tensor) -> ViewMeasures:
        """Measure X on the sampled rays of all views."""
        books = [view.rows for view in self.pieces.codebook.views]
        return measure_samples(self.pieces.samples(), X, books, self.threads)
