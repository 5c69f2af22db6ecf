"""What judges thresholds: intersections, the best possible threshold, and the pixel that stands for an object."""

from __future__ import annotations

import pytest
import torch

from liftcore.evaluate.accuracy import mask_iou
from tests.benchmarks.examples import deepest_pixel
from tests.benchmarks.thresholds import best_iou


def test_no_threshold_beats_the_best_one() -> None:
    generator = torch.Generator().manual_seed(3)
    attention = torch.rand(20, 30, generator=generator).mul(20).round()  # with many equal scores
    truth = (attention + 8 * torch.rand(20, 30, generator=generator)) > 16
    met = torch.rand(20, 30, generator=generator) > 0.1
    tried = [mask_iou(met & (attention >= cut), truth) for cut in attention.unique().tolist()]
    assert best_iou(attention, met, truth) == pytest.approx(max(tried))


def test_two_empty_masks_agree() -> None:
    empty = torch.zeros(3, 3, dtype=torch.bool)
    assert mask_iou(empty, empty) == 1.0
    assert mask_iou(empty, ~empty) == 0.0


def test_the_deepest_pixel_is_inside_and_far_from_the_border() -> None:
    mask = torch.zeros(20, 30, dtype=torch.bool)
    mask[2:5, 2:28] = True  # long and thin
    mask[8:17, 10:19] = True  # a square around (14, 12)
    assert deepest_pixel(mask) == (14, 12)
    assert deepest_pixel(torch.ones(5, 5, dtype=torch.bool)) == (2, 2)  # the image's edge is a border
