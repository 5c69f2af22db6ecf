"""Candidates for the target of a click: the nested nodes of the lift's tree at this place, the smallest first.

A pixel has splats with their weights on its ray, an area those on the rays of its pixels, a splat only itself. From
the largest node down, the node with most of this weight is taken: a root if it has ROOT_SHARE of it, a part if it has
half of the weight of its whole. A part with more than TWIN_SHARE of the splats of its whole looks the same, and is
left out. With several examples, a node must contain each, and no negative example.

A text that names a part for which there is no word may mean any part of its object (`parts_of`).
"""

from __future__ import annotations

import numpy as np

from liftcore.query.areas import area_splats
from liftcore.query.question import Candidate, Query
from liftcore.query.scene import Scene
from liftcore.query.terms import Area, SplatSet, SplatTerm, Term

MOST_PARTS = 8  # candidates for a word, the largest
TWIN_SHARE = 0.75  # of the splats of a whole: mistakes of masks leave such parts, which look like the whole
ROOT_SHARE = 0.25  # of the weight at the click: less is visible through the object, or lies next to it


def candidates(scene: Scene, query: Query) -> tuple[Candidate, ...]:
    """Return the nested nodes that examples of places may mean, the smallest first; () for words and vectors."""
    positives, negatives = query.positives, query.terms[len(query.positives) :]
    if (
        not positives
        or scene.object_views is None
        or not all(isinstance(term, Area | SplatTerm) for term in positives)
    ):
        return ()
    paths = [_path(scene, term) for term in positives]
    against = [set(_path(scene, term)) for term in negatives if isinstance(term, Area | SplatTerm)]
    shared = [
        node
        for node in paths[0]
        if all(node in path for path in paths) and not any(node in other for other in against)
    ]
    nodes = list[Candidate]()
    for node in shared:
        candidate = _candidate(scene, node, min(path[node] for path in paths))
        if not nodes or candidate.splats <= TWIN_SHARE * nodes[-1].splats:
            nodes.append(candidate)
    return tuple(reversed(nodes))


def parts_of(scene: Scene, objects: np.ndarray) -> tuple[Candidate, ...]:
    """Return at most `MOST_PARTS` parts of some objects [N] bool, the largest first, with their shares of these."""
    if scene.node_parents is None or scene.object is None:
        return ()
    total = scene.total_weight[np.append(objects, False)[scene.object]].sum() or 1.0
    nodes = np.flatnonzero(
        np.append(objects, np.zeros(len(scene.node_parents) - len(objects) + 1, np.bool_))[scene.node_parents]
    )
    parts = [
        _candidate(scene, node, float(scene.total_weight[scene.members(node)].sum() / total))
        for node in nodes.tolist()
    ]
    return tuple(sorted(parts, key=lambda c: (-c.share, c.id))[:MOST_PARTS])


def _path(scene: Scene, example: Term) -> dict[int, float]:
    """Return the nodes at an example's place, the largest first, and the share of its weight in each."""
    if isinstance(example, SplatTerm):
        rows, weights = np.array([example.splat]), np.ones(1)
    else:
        assert isinstance(example, Area)
        rows, weights = area_splats(scene, example)
    assert scene.node is not None and scene.node_parents is not None
    shares, parents = dict[int, float](), scene.node_parents
    above, part = scene.node[rows].astype(np.int64), weights / weights.sum()
    while (inside := above >= 0).any():
        above, part = above[inside], part[inside]
        for node, weight in zip(above.tolist(), part.tolist(), strict=True):
            shares[node] = shares.get(node, 0.0) + weight
        above = parents[above]
    path, parent, least = dict[int, float](), -1, ROOT_SHARE
    while parts := [node for node in shares if parents[node] == parent]:
        best = max(parts, key=lambda node: (shares[node], -node))
        if shares[best] < least:
            break
        path[best], parent, least = shares[best], best, shares[best] / 2
    return path


def _candidate(scene: Scene, node: int, share: float) -> Candidate:
    node_set = SplatSet("object", str(node))
    splats = int(scene.members(node).sum())
    kind, confidence = scene.node_kind(node), scene.confidence_of(node)
    return Candidate(id=node, set=str(node_set), kind=kind, splats=splats, share=share, confidence=confidence)
