"""Transfer of a lift to other splats of the same scene: cropped, reordered, compressed, decimated, moved, retrained.

Each new splat takes values of the old ones that it overlaps. With the centres' difference d, covariances S_j and
S_k with mean S, and base colours in 0..1, the weight of an old splat k at a new one j is the overlap of the two
Gaussians (Bhattacharyya's coefficient) times their likeness in colour::

    w_jk = (|S_j| |S_k|)^(1/4) / |S|^(1/2) exp(-d^T S^-1 d / 8) exp(-(|rgb_j - rgb_k| / 0.1)^2 / 2)

A new splat that nearly equals an old one takes the values of that one alone, so that unchanged rows keep their
values. Of exact copies among the old, which cannot be distinguished, it takes the mean. All others take the mean of
per-splat values by w^2 over the 16 nearest old ones, and the cluster and object of the largest sum. The total weight
of an old splat is divided among the new ones that it overlaps, so that decimated splats have that of all old ones
they replace. A new splat that overlaps none has no feature.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch

from liftcore.errors import InvalidSplats
from liftcore.runtime.progress import Progress, silent
from liftcore.runtime.torch_modes import default_modes
from liftcore.scene.neighbours import COLOUR_WIDTH, base_colours, set_apart
from liftcore.scene.quaternions import rotation_matrices
from liftcore.scene.registration import find_similarity
from liftcore.scene.similarity import Similarity
from liftcore.values.lift import NO_FILE, cropped_tree, landmarks_of, renumbered
from liftcore.values.lift_file import NODE_TENSORS

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats
    from liftcore.values.lift import Lift

    AnyLift = TypeVar("AnyLift", bound=Lift)

NEIGHBOURS = 16  # most old splats whose values a new one takes
SAME_SPLAT = 0.9  # overlap and likeness from which two splats are one
LEAST_OVERLAP = 0.05  # of a partner
THINNEST = 0.02  # of a splat's largest scale, the least that scales count: so flat splats overlap, too
STILL = 0.9  # share of a sample with partners in place, from which no transformation is searched
UNLIKELY = 0.5  # share below which the scene must have been transformed
GAIN = 0.1  # least gain of that share by a transformation
SAMPLE = 4_000
_BLOCK = 1 << 12  # new splats at once: [n, 16, F] features in f32
_VALUES = ("view_consistency", "confidence")


@default_modes()
def transfer(lift: AnyLift, old: Splats, new: Splats, matrix: Any = None, progress: Progress = silent) -> AnyLift:
    """Take a lift's features, total weight, clusters and objects to another set of splats of its scene.

    Args:
        lift: of any engine; it stays as it is. old: that were lifted. new: Q others, in any order and place.
        matrix: [4, 4], the similarity from the old frame to the new one; None: none, or one that is found.
        progress: called with the stage "transfer".

    Returns:
        The lift of the new splats, whose diagnostics have ``transfer``: how many are rows of the old ones, how many
        are mixed, how many found no partner, and the similarity, None where the scene was not moved.

    Raises:
        InvalidSplats: other splats than were lifted, or no place of the new ones in the old scene is clear.
        InvalidInput: the matrix is no similarity.
    """
    lift.require_splats(old)
    move = None if matrix is None else Similarity.of(matrix)
    index = _Index(old)
    move = _find_move(index, old, new) if move is None else move
    seen_from = new if move is None else new.transformed(**_inverse(move))
    fields, counts = _mix_values(lift, index, seen_from, progress)
    facts: dict[str, Any] = {"from_splats": lift.features.shape[0], **counts, "moved": None}
    if move is not None:
        facts["moved"] = {"scale": move.scale, "rotation": move.rotation.tolist()}
        facts["moved"] |= {"translation": move.translation.tolist()}
    diagnostics = lift.diagnostics | {"transfer": facts}
    if isinstance(plan := diagnostics.get("plan"), dict):
        diagnostics["plan"] = plan | {"kernel": str(new.kernel)}
    changes: dict[str, Any] = {"diagnostics": diagnostics, "splats": NO_FILE, "landmarks": landmarks_of(new)}
    changes |= {"origin": new.origin, "settings": lift.settings.model_copy(update={"kernel": str(new.kernel)})}
    world = new.world.known_or(lift.metadata.world if move is None else lift.metadata.world.transformed(move))
    changes |= {"world": world} | ({} if move is None else {"cameras": NO_FILE, "poses": ""})
    return replace(lift, **fields, metadata=lift.metadata.model_copy(update=changes))


def _find_move(index: _Index, old: Splats, new: Splats) -> Similarity | None:
    """Find a similarity after which clearly more new splats have partners than in place; None if there is none.

    Raises:
        InvalidSplats: few have a partner in place, and no similarity is clear.
    """
    share = index.share_of_partners(new)
    if share >= STILL:
        return None
    try:
        move = find_similarity(old, new)
    except InvalidSplats:
        if share < UNLIKELY:
            raise
        return None
    return move if index.share_of_partners(new, move) > share + GAIN else None


def _inverse(move: Similarity) -> dict[str, Any]:
    rotation = move.rotation.T
    return {"scale": 1 / move.scale, "rotation": rotation, "translation": -(rotation @ move.translation) / move.scale}


class _Index:
    """Spatial index of the old splats."""

    def __init__(self, old: Splats) -> None:
        from scipy.spatial import KDTree

        self.means = old.positions().astype(np.float64)
        self.tree = KDTree(set_apart(self.means))
        self.shapes, self.colours = _covariances(old), base_colours(old)

    def partners(self, new: Splats) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """Yield blocks of new splats: their rows, their nearest old ones [n, k] and the weights w [n, k] f64."""
        means, colours = new.positions().astype(np.float64), base_colours(new)
        shapes = _covariances(new)
        for first in range(0, len(means), _BLOCK):
            rows = slice(first, min(first + _BLOCK, len(means)))
            near = self.tree.query(means[rows], min(NEIGHBOURS, len(self.means)), workers=-1)[1]
            near = near.reshape(rows.stop - first, -1)
            weights = _overlaps(means[rows, None] - self.means[near], shapes[:, rows, None], self.shapes[:, near])
            if colours is not None and self.colours is not None:
                squares = ((colours[rows, None] - self.colours[near]) ** 2).sum(axis=2)
                weights *= np.exp(-0.5 * squares / COLOUR_WIDTH**2)
            yield rows, near, weights

    def share_of_partners(self, new: Splats, move: Similarity | None = None) -> float:
        """Return the share of a sample of new splats that overlap an old one, in place or moved back by ``move``."""
        sample = new[np.linspace(0, new.count - 1, min(SAMPLE, new.count)).astype(int)]
        sample = sample if move is None else sample.transformed(**_inverse(move))
        return float(np.mean(np.concatenate([w.max(axis=1) >= LEAST_OVERLAP for _, _, w in self.partners(sample)])))


def _covariances(splats: Splats) -> np.ndarray:
    """Compute covariances [6, P] f64, xx xy xz yy yz zz, with scales of at least THINNEST of a splat's largest."""
    logs = splats.log_scales.cpu().numpy().astype(np.float64).clip(-80, 80)
    scales = np.exp(np.pad(logs, ((0, 0), (0, 3 - logs.shape[1])), constant_values=-80))
    scales = np.maximum(scales, THINNEST * scales.max(axis=1, keepdims=True))
    axes = rotation_matrices(splats.quats.cpu().numpy()) * scales[:, None]
    return np.stack([(axes[:, i] * axes[:, j]).sum(axis=1) for i in range(3) for j in range(i, 3)])


def _overlaps(offsets: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute Bhattacharyya's coefficients of Gaussians, [n, k] f64 in 0..1.

    Args:
        offsets: [n, k, 3], differences of centres. a: [6, n, 1] and b: [6, n, k], covariances (`_covariances`).
    """
    middle = (a + b) / 2
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        determinant = _determinants(middle)
        sizes = (_determinants(a) * _determinants(b) / determinant**2) ** 0.25
        squares = (_cofactors(middle) * _products(np.moveaxis(offsets, -1, 0))).sum(axis=0) / determinant
        return np.nan_to_num(sizes * np.exp(-squares / 8))


def _determinants(shapes: np.ndarray) -> np.ndarray:
    return (_cofactors(shapes)[:3] * shapes[:3]).sum(axis=0)


def _cofactors(shapes: np.ndarray) -> np.ndarray:
    """Compute the cofactors [6, ...] of symmetric matrices [6, ...]: inverses times determinants."""
    xx, xy, xz, yy, yz, zz = shapes
    sides = (
        yy * zz - yz**2,
        xz * yz - xy * zz,
        xy * yz - xz * yy,
        xx * zz - xz**2,
        xy * xz - xx * yz,
        xx * yy - xy**2,
    )
    return np.stack(sides)


def _products(vectors: np.ndarray) -> np.ndarray:
    """Compute the factors [6, ...] of a symmetric matrix's entries in v^T S v, of vectors [3, ...]."""
    x, y, z = vectors
    return np.stack([x * x, 2 * x * y, 2 * x * z, y * y, 2 * y * z, z * z])


def _mix_values(lift: Lift, index: _Index, new: Splats, progress: Progress) -> tuple[dict[str, Any], dict[str, int]]:
    """Return the fields of the new splats' lift, and the numbers of rows copied, mixed and without a partner."""
    count = new.count
    features = torch.zeros((count, lift.features.shape[1]), dtype=lift.features.dtype)
    values = {name: np.zeros(count, np.float32) for name in _VALUES if getattr(lift, name) is not None}
    kinds = [name for name in ("cluster", "object", "node") if getattr(lift, name) is not None]
    tuples, own_tuple = np.unique(
        np.stack([np.full(len(lift), -1), *(getattr(lift, name).cpu().numpy() for name in kinds)], axis=1),
        axis=0,
        return_inverse=True,
    )  # a splat's cluster, object and node go together
    tuple_of = np.full(count, -1)
    has_feature, copied_count, mixed_count = np.zeros(count, bool), 0, 0
    partners: list[tuple[np.ndarray, np.ndarray]] = []  # of each block
    old = {name: getattr(lift, name).cpu().numpy() for name in (*values, "has_feature")}
    own_tuple = own_tuple.reshape(-1)
    old_features = lift.features.cpu()
    for rows, near, overlaps in index.partners(new):
        best = overlaps.argmax(axis=1)
        top = np.take_along_axis(overlaps, best[:, None], axis=1)
        copies = overlaps >= top  # the best, and exact copies of it
        shares = np.where(top >= SAME_SPLAT, copies, overlaps**2 * (overlaps >= LEAST_OVERLAP))
        shares /= np.maximum(shares.sum(axis=1, keepdims=True), 1e-300)
        partners.append((near.astype(np.int32), shares.astype(np.float32)))
        feature_shares = shares * old["has_feature"][near]
        sums = feature_shares.sum(axis=1)
        has_feature[rows] = sums >= 0.5
        is_row, is_mixed = top[:, 0] >= SAME_SPLAT, (top[:, 0] < SAME_SPLAT) & (top[:, 0] >= LEAST_OVERLAP)
        copied_count, mixed_count = copied_count + int(is_row.sum()), mixed_count + int(is_mixed.sum())
        is_one = is_row & (copies.sum(axis=1) == 1)
        old_rows = near[is_one, best[is_one]]
        features[rows.start + np.flatnonzero(is_one)] = old_features[old_rows]
        tuple_of[rows][is_one] = own_tuple[old_rows]
        is_mean = (is_row | is_mixed) & ~is_one
        several = rows.start + np.flatnonzero(is_mean)
        feature_shares = torch.from_numpy(
            (feature_shares[is_mean] / np.maximum(sums[is_mean, None], 1e-300)).astype(np.float32)
        )
        mixture = torch.einsum("nk,nkf->nf", feature_shares, old_features[near[is_mean]].float())
        features[several] = mixture.to(features.dtype)
        tuple_of[several] = _strongest_label(own_tuple[near[is_mean]], shares[is_mean])
        for name, column in values.items():
            column[rows] = (shares * old[name][near]).sum(axis=1)
        progress("transfer", rows.stop, count, "splats")
    features[~torch.from_numpy(has_feature)] = 0
    values["total_weight"] = _divide_weight(
        lift.total_weight.cpu().numpy(), *map(np.concatenate, zip(*partners, strict=True))
    )
    fields: dict[str, Any] = {"features": features, "has_feature": torch.from_numpy(has_feature)}
    fields |= {name: torch.from_numpy(column) for name, column in values.items()}
    labels = np.where(tuple_of[:, None] >= 0, tuples[tuple_of], -1).astype(np.int32)
    fields |= {name: torch.from_numpy(labels[:, place].copy()) for place, name in enumerate(kinds, 1)}
    for name, table in (("cluster", "cluster_features"), ("object", "object_views")):
        if name in kinds and (table_values := getattr(lift, table)) is not None:
            fields[name], fields[table] = renumbered(fields[name], table_values.cpu())
    if lift.node is not None:
        fields |= cropped_tree({name: getattr(lift, name).cpu() for name in NODE_TENSORS} | {"node": fields["node"]})
    return fields, {"rows": copied_count, "mixed": mixed_count, "without_partner": count - copied_count - mixed_count}


def _strongest_label(labels: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the label of [n, k] with the largest sum of weights, [n] i32; -1 where all weights are zero."""
    votes = (weights[:, :, None] * (labels[:, :, None] == labels[:, None, :])).sum(axis=1)
    best = np.take_along_axis(labels, votes.argmax(axis=1)[:, None], axis=1)[:, 0]
    return np.where(weights.any(axis=1), best, -1).astype(np.int32)


def _divide_weight(total_weight: np.ndarray, near: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Divide the total weight [P] of each old splat among the new ones by their shares [Q, k] in it, [Q] f32."""
    totals = np.bincount(near.ravel(), shares.ravel().astype(np.float64), len(total_weight))
    per_share = np.divide(total_weight, totals, out=np.zeros(len(total_weight)), where=totals > 0)
    return (shares * per_share[near]).sum(axis=1).astype(np.float32)
