"""Levels put together or taken alone say what the dense maps of the field would."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from liftcore.errors import InvalidFeatures
from liftcore.features import levels
from liftcore.features.levels import at_levels, composite
from liftcore.features.views import NO_LABEL, Regions
from tests.scenes import random_grid, random_regions


def dense_sums(regions: Regions) -> np.ndarray:
    """[h * w, F], pixel by pixel: the normalised sum of the embeddings of its labels, zero without any."""
    labels, codebook = regions.labels.numpy(), regions.codebook.double().numpy()
    _, rows, columns = labels.shape
    dense = np.zeros((rows, columns, codebook.shape[1]))
    for y in range(rows):
        for x in range(columns):
            for label in labels[:, y, x]:
                if label != NO_LABEL:
                    dense[y, x] += codebook[label]
            length = np.linalg.norm(dense[y, x])
            dense[y, x] /= length if length > 0 else 1
    return dense.reshape(-1, codebook.shape[1])


def read(regions: Regions) -> np.ndarray:
    """[h * w, F]: the row that each pixel of a one-level map reads, zero without a label."""
    labels = regions.labels.long().flatten()
    return np.where(labels[:, None] >= 0, regions.codebook.double().numpy()[labels], 0.0)


@pytest.mark.parametrize("levels", [1, 2, 4])
@pytest.mark.parametrize("seed", range(3))
def test_composite_regions_are_normalised_sums_pixel_by_pixel(seed, levels):
    regions = random_regions(seed, levels, rows=7)
    merged = composite(regions, "v0")
    assert merged.labels.shape == (1, *regions.labels.shape[1:])
    assert np.abs(read(merged) - dense_sums(regions)).max() < 1e-6


def test_a_composite_codebook_has_a_row_for_each_distinct_tuple():
    regions = random_regions(3, 3, rows=4)
    tuples = {tuple(labels) for labels in regions.labels.reshape(3, -1).T.tolist()} - {(NO_LABEL,) * 3}
    merged = composite(regions, "v0")
    assert merged.codebook.shape[0] == len(tuples)
    assert merged.labels.unique().tolist() in ([*range(len(tuples))], [NO_LABEL, *range(len(tuples))])


def test_many_levels_and_rows_do_not_overflow_the_numbering():
    labels = torch.randint(-1, 30_000, (8, 20, 20), dtype=torch.int32, generator=torch.Generator().manual_seed(0))
    regions = Regions(labels, torch.nn.functional.normalize(torch.randn(30_000, 3), dim=1))
    assert np.abs(read(composite(regions, "v0")) - dense_sums(regions)).max() < 1e-5


@pytest.mark.parametrize(("dtype", "size"), [(torch.float16, 6e4), (torch.float32, 9e14), (torch.float32, 1e-38)])
def test_huge_and_tiny_embeddings_keep_their_direction(dtype, size):
    codebook = torch.tensor([[size, 0.0], [size, size], [0.0, 0.0]]).to(dtype)
    regions = Regions(torch.tensor([[[0, 2]], [[1, -1]]], dtype=torch.int32), codebook)
    expected = np.array([[2, 1] / np.sqrt(5), [0, 0]])
    assert np.abs(read(composite(regions, "v0")) - expected).max() < 1e-3


def test_a_map_without_any_label_stays_one():
    regions = Regions(torch.full((2, 3, 4), NO_LABEL, dtype=torch.int32), torch.ones(2, 5))
    assert (composite(regions, "v0").labels == NO_LABEL).all()


def test_tuples_are_summed_in_pieces_and_refused_where_their_codebook_would_be_huge(monkeypatch):
    generator = torch.Generator().manual_seed(2)
    labels = torch.randint(-1, 9, (3, 20, 20), dtype=torch.int32, generator=generator)
    regions = Regions(labels, torch.nn.functional.normalize(torch.randn(9, 7, generator=generator), dim=1))
    whole = composite(regions, "v0")
    monkeypatch.setattr(levels, "BLOCK_FLOATS", 21)
    assert torch.equal(composite(regions, "v0").codebook, whole.codebook)
    monkeypatch.setattr(levels, "COMPOSITE_BYTES", whole.codebook.nbytes)
    assert torch.equal(composite(regions, "v0").labels, whole.labels)
    monkeypatch.setattr(levels, "COMPOSITE_BYTES", whole.codebook.nbytes - 1)
    with pytest.raises(
        InvalidFeatures, match=f"IMG_7.*{whole.codebook.shape[0]} tuples of 7 channels.*levels to rows"
    ):
        composite(regions, "IMG_7")


def test_one_level_is_that_level_alone():
    regions = random_regions(1, 3)
    taken = at_levels(regions, 2, "v0")
    assert isinstance(taken, Regions)
    assert torch.equal(taken.labels, regions.labels[2:])
    assert taken.codebook is regions.codebook


def test_rows_and_grids_stay_as_they_are():
    regions, grid = random_regions(1), random_grid(1)
    assert at_levels(regions, "rows", "v0") is regions
    assert all(at_levels(grid, levels, "v0") is grid for levels in ("rows", "composite", 0))


@pytest.mark.parametrize("observation", [random_regions(0, levels=2), random_grid(0)])
def test_a_level_that_a_view_lacks_is_refused_by_name(observation):
    with pytest.raises(InvalidFeatures, match="IMG_7"):
        at_levels(observation, 2, "IMG_7")
