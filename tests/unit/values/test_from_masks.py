"""Regions of masks that may overlap: no pixel of any mask is lost, and invalid masks are refused by name."""

from typing import Any

import numpy as np
import pytest
import torch

import liftcore as lc

OVERLAPPING = np.array([[[1, 1, 0, 0]], [[0, 1, 1, 0]], [[0, 0, 0, 1]], [[0, 0, 0, 0]]], dtype=bool)  # [4, 1, 4]
VECTORS = np.eye(4, 3, dtype=np.float32)


@pytest.mark.parametrize(
    "form", [np.asarray, torch.from_numpy, list, lambda masks: list(torch.from_numpy(masks)), lambda m: m[:, None]]
)
def test_each_pixel_has_a_label_of_each_mask_that_it_lies_under(form: Any) -> None:
    regions = lc.Regions.from_masks(form(OVERLAPPING), VECTORS)
    assert torch.equal(regions.codebook, torch.from_numpy(VECTORS))
    for number, mask in enumerate(OVERLAPPING):
        on = (regions.labels == number).numpy()
        assert np.array_equal(on.any(axis=0), mask) and on.sum() == mask.sum()
    assert regions.labels.shape == (2, 1, 4)


@pytest.mark.parametrize(
    ("masks", "vectors", "message"),
    [
        (OVERLAPPING.astype(np.float32), VECTORS, r"masks: expected booleans \[M, H, W\].*got float32.*> 0.5"),
        ([np.ones((2, 2), bool), np.ones((2, 3), bool)], VECTORS, "masks: expected booleans"),
        (OVERLAPPING[:3], VECTORS, r"masks: expected 4 masks, one a vector, got 3 .*row k of the vectors"),
        (OVERLAPPING, VECTORS.astype(int), r"vectors: expected floats \[M, F\], got int64"),
    ],
)
def test_wrong_masks_are_refused_by_their_name(masks: Any, vectors: Any, message: str) -> None:
    with pytest.raises(lc.InvalidFeatures, match=message):
        lc.Regions.from_masks(masks, vectors)
