"""Which regions of a view the clusters confirm: a contingency table and IoUs (paper, Post Aggregation Filtering).

``kappa`` [H, W] is the view's cluster image. A region is kept when it and the whole footprint of the cluster that
most of its pixels show overlap by ``IoU >= tau``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

from liftcore.solve.clustering import NO_CLUSTER


@dataclass(frozen=True)
class RegionMatches:
    """The cluster that each region of a view shows most, and how well they match."""

    clusters: np.ndarray  # [M] i64, -1 where it is none, or where no pixel reads the region
    ious: np.ndarray  # [M] f64, 0 there
    present: np.ndarray  # [M] bool, whether any pixel reads the region


def match_regions(labels: np.ndarray, kappa: np.ndarray, rows: int, clusters: int) -> RegionMatches:
    """Match the regions of a view with clusters.

    Args:
        labels: [L, h, w] i32 in -1..rows - 1, of any size; a region is the union of its pixels on all levels.
        kappa: [H, W] i32 in -1..clusters - 1.
    """
    table = contingency(labels, kappa, rows, clusters)
    areas = np.asarray(table.sum(axis=1)).ravel()
    majority, shared = _largest(table)
    footprints = np.bincount(kappa.ravel() + 1, minlength=clusters + 1)
    unions = areas + footprints[majority] - shared
    matched = (areas > 0) & (majority > 0)
    ious = np.divide(shared, unions, out=np.zeros(rows), where=matched)
    return RegionMatches(np.where(matched, majority - 1, NO_CLUSTER), ious, areas > 0)


def contingency(labels: np.ndarray, kappa: np.ndarray, rows: int, clusters: int) -> csr_matrix:
    """[M, K + 1] i64: pixels of the image that read a region and show a cluster; the first column is for none."""
    height, width = kappa.shape
    levels, label_rows, label_columns = labels.shape
    y = (2 * np.arange(height) + 1) * label_rows // (2 * height)
    x = (2 * np.arange(width) + 1) * label_columns // (2 * width)
    shown = (kappa + 1).ravel()
    total = csr_matrix((rows, clusters + 1), dtype=np.int64)
    read: list[np.ndarray] = []
    for level in range(levels):
        own = labels[level][y[:, None], x].ravel()
        counted = own >= 0
        for other in read:
            counted &= own != other  # a region on two levels counts a pixel once
        read.append(own)
        ones = np.ones(int(counted.sum()), np.int64)
        total += csr_matrix((ones, (own[counted], shown[counted])), shape=total.shape)  # equal places add up
    return total


def _largest(table: csr_matrix) -> tuple[np.ndarray, np.ndarray]:
    """Column and value of the largest entry of each row, the first of equal ones; (0, 0) for an empty row."""
    table.sort_indices()
    indices, starts, data = (np.asarray(part, np.int64) for part in (table.indices, table.indptr, table.data))
    columns, values = np.zeros(starts.size - 1, np.int64), np.zeros(starts.size - 1, np.int64)
    lengths = np.diff(starts)
    filled = np.flatnonzero(lengths)
    if filled.size:
        largest = np.maximum.reduceat(data, starts[filled])
        row_of_entry = np.repeat(np.arange(filled.size), lengths[filled])
        places = np.flatnonzero(data == largest[row_of_entry])
        first = places[np.unique(row_of_entry[places], return_index=True)[1]]
        columns[filled], values[filled] = indices[first], largest
    return columns, values
