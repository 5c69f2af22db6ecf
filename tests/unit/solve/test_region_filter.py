"""Contingency, majority and IoU against loops over pixels."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from liftcore.solve.aggregate import contingency, match_regions

example = settings(max_examples=60, deadline=None)


@st.composite
def views(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, int, int]:
    """Labels [L, h, w], kappa [H, W], rows and clusters; few labels, so that regions and ties are large."""
    rng = np.random.default_rng(draw(st.integers(0, 2**20)))
    rows, clusters = draw(st.integers(1, 6)), draw(st.integers(1, 5))
    labels = rng.integers(-1, rows, (draw(st.integers(1, 3)), draw(st.integers(1, 9)), draw(st.integers(1, 9))))
    kappa = rng.integers(-1, clusters, (draw(st.integers(1, 8)), draw(st.integers(1, 8))))
    return labels.astype(np.int32), kappa.astype(np.int32), rows, clusters


def pixels_of(labels: np.ndarray, row: int, shape: tuple[int, int]) -> np.ndarray:
    """[H, W] bool: the image pixels that read a row of the codebook on any level."""
    H, W = shape
    h, w = labels.shape[1:]
    mask = np.zeros(shape, bool)
    for y in range(H):
        for x in range(W):
            mask[y, x] = row in labels[:, int((y + 0.5) * h / H), int((x + 0.5) * w / W)]
    return mask


@example
@given(views())
def test_the_table_counts_each_pixel_of_a_region_once(view):
    labels, kappa, rows, clusters = view
    table = contingency(labels, kappa, rows, clusters).toarray()
    for row in range(rows):
        mask = pixels_of(labels, row, kappa.shape)
        expected = [int((mask & (kappa == cluster)).sum()) for cluster in range(-1, clusters)]
        assert table[row].tolist() == expected


@example
@given(views())
def test_a_region_is_held_against_the_whole_footprint_of_its_majority_cluster(view):
    labels, kappa, rows, clusters = view
    matches = match_regions(labels, kappa, rows, clusters)
    for row in range(rows):
        mask = pixels_of(labels, row, kappa.shape)
        counts = [int((mask & (kappa == cluster)).sum()) for cluster in range(-1, clusters)]
        majority = counts.index(max(counts)) - 1
        assert matches.present[row] == mask.any()
        if majority < 0:
            assert matches.clusters[row] == -1 and matches.ious[row] == 0
        else:
            footprint = kappa == majority
            assert matches.clusters[row] == majority
            assert matches.ious[row] == (mask & footprint).sum() / (mask | footprint).sum()


def test_a_region_that_is_a_footprint_matches_wholly_at_any_size_of_the_map():
    kappa = np.full((12, 18), -1, np.int32)
    kappa[3:9, 6:12] = 1
    coarse = np.where(kappa[::3, ::3] == 1, 4, -1)[None].astype(np.int32)
    for labels in (coarse, np.repeat(np.repeat(coarse, 6, axis=1), 6, axis=2)):
        matches = match_regions(labels, kappa, rows=6, clusters=2)
        assert matches.clusters.tolist() == [-1, -1, -1, -1, 1, -1]
        assert matches.ious[4] == 1.0
