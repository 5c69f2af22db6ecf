"""What a click may mean: the nested nodes of the lift's tree that hold what is shown there, the smallest first.

A pixel shows splats by their weights on its ray, an area by those on the rays of its pixels, a splat itself. From the
largest node down, the one with most of that weight is taken, a root where it has ROOT_SHARE of it, a part where it
has half of what its whole has. One with more than TWIN_SHARE of the splats of its whole looks like that, and is left
out. Of several examples a node must hold each, and none that an example against is in.

A text that names a part for which there is no word may mean any part of its thing (`parts_of`).
"""

from __future__ import annotations

import numpy as np

from liftcore.query.areas import splats_shown
from liftcore.query.opened import OpenedLift
from liftcore.query.question import Candidate, Query
from liftcore.query.terms import Area, SplatSet, SplatTerm, Term

MOST_PARTS = 8  # that are offered for a word: the largest
TWIN_SHARE = 0.75  # of the splats of a whole: mistakes of masks leave such parts, and to the eye they are the whole
ROOT_SHARE = 0.25  # of what is shown: less is what shines through, or lies beside the thing


def candidates(scene: OpenedLift, query: Query) -> tuple[Candidate, ...]:
    """The nodes that examples of places may mean, nested, the smallest first; none for words and vectors.

    Raises:
        InvalidQuery, NotFound, InvalidLift: as `liftcore.query.areas.feature_shown`.
    """
    wanted, unwanted = query.positives, query.terms[len(query.positives) :]
    if not wanted or scene.object_views is None or not all(isinstance(one, Area | SplatTerm) for one in wanted):
        return ()
    paths = [_path(scene, one) for one in wanted]
    against = [set(_path(scene, one)) for one in unwanted if isinstance(one, Area | SplatTerm)]
    kept = [
        node
        for node in paths[0]
        if all(node in path for path in paths) and not any(node in other for other in against)
    ]
    nodes = list[Candidate]()
    for node in kept:
        candidate = _candidate(scene, node, min(path[node] for path in paths))
        if not nodes or candidate.splats <= TWIN_SHARE * nodes[-1].splats:
            nodes.append(candidate)
    return tuple(reversed(nodes))


def parts_of(scene: OpenedLift, things: np.ndarray) -> tuple[Candidate, ...]:
    """The parts of some objects [N] bool, with the largest first, `MOST_PARTS` at most, and their shares of these."""
    if scene.node_parents is None or scene.object is None:
        return ()
    whole = scene.evidence[np.append(things, False)[scene.object]].sum() or 1.0
    nodes = np.flatnonzero(
        np.append(things, np.zeros(len(scene.node_parents) - len(things) + 1, np.bool_))[scene.node_parents]
    )
    found = [
        _candidate(scene, node, float(scene.evidence[scene.members(node)].sum() / whole)) for node in nodes.tolist()
    ]
    return tuple(sorted(found, key=lambda one: (-one.share, one.id))[:MOST_PARTS])


def _path(scene: OpenedLift, example: Term) -> dict[int, float]:
    """The nodes that hold what an example shows, the largest first, and what share of it each holds."""
    if isinstance(example, SplatTerm):
        rows, weights = np.array([example.splat]), np.ones(1)
    else:
        assert isinstance(example, Area)
        rows, weights = splats_shown(scene, example)
    labels = scene.object if scene.node is None else scene.node
    assert labels is not None and scene.object_views is not None
    parents = np.full(len(scene.object_views), -1) if scene.node_parents is None else scene.node_parents
    shares = dict[int, float]()
    above, part = labels[rows].astype(np.int64), weights / weights.sum()
    while (inside := above >= 0).any():
        above, part = above[inside], part[inside]
        for node, weight in zip(above.tolist(), part.tolist(), strict=True):
            shares[node] = shares.get(node, 0.0) + weight
        above = parents[above]
    path, whole, least = dict[int, float](), -1, ROOT_SHARE
    while parts := [node for node in shares if parents[node] == whole]:
        best = max(parts, key=lambda node: (shares[node], -node))
        if shares[best] < least:
            break
        path[best], whole, least = shares[best], best, shares[best] / 2
    return path


def _candidate(scene: OpenedLift, node: int, share: float) -> Candidate:
    named = SplatSet("object", str(node))
    confidence = None if scene.node_confidence is None else float(scene.node_confidence[node])
    splats = int(scene.members(node).sum())
    kind = scene.node_kind(node)
    return Candidate(id=node, set=str(named), kind=kind, splats=splats, share=share, confidence=confidence)
