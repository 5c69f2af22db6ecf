"""What judges objects."""

from __future__ import annotations

import numpy as np
import pytest

from tests.benchmarks.objects import box_iou


def test_boxes_share_what_lies_in_both() -> None:
    unit, shifted = np.array([[0.0] * 3, [1.0] * 3]), np.array([[0.5, 0.0, 0.0], [1.5, 1.0, 1.0]])
    assert box_iou(unit, unit) == 1.0
    assert box_iou(unit, shifted) == pytest.approx(0.5 / 1.5)
    assert box_iou(unit, unit + 2.0) == 0.0  # apart on all axes: no volume from two signs
    assert box_iou(unit, unit + np.array([0.0, 3.0, 0.0])) == 0.0
    assert box_iou(np.zeros((2, 3)), np.zeros((2, 3))) == 0.0
