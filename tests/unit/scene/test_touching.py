"""Groups of splats that touch, compared with the rule pair by pair."""

from dataclasses import replace

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from liftcore.scene.neighbours import NEIGHBOURS
from liftcore.scene.splats import Kernel, Splats
from liftcore.scene.touching import REACH, touching
from tests.scenes import random_splats

FEW = NEIGHBOURS + 1  # of so many splats, each looks at all others


def by_pairs(splats: Splats) -> np.ndarray:
    """Return groups by the rule itself, for so few splats that all are neighbours."""
    count = splats.count
    means = splats.means.double().numpy()
    axes = [
        Rotation.from_quat(splats.quats[j].double().numpy(), scalar_first=True).as_matrix()[
            :, : splats.log_scales.shape[1]
        ]
        * splats.log_scales[j].double().exp().numpy()
        for j in range(count)
    ]
    groups = np.arange(count)
    for j in range(count):
        for k in range(j):
            offset = means[j] - means[k]
            distance = np.linalg.norm(offset)
            line = offset / distance if distance else np.zeros(3)
            if distance <= REACH * sum(np.linalg.norm(axes[i].T @ line) for i in (j, k)):
                groups[groups == groups[j]] = groups[k]
    return groups


def same_partition(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(((a[:, None] == a) == (b[:, None] == b)).all())


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6), count=st.integers(1, FEW), spread=st.floats(0.2, 5.0),
    kernel=st.sampled_from(list(Kernel)),
)  # fmt: skip
def test_groups_are_those_of_the_rule(seed: int, count: int, spread: float, kernel: Kernel) -> None:
    splats = random_splats(seed, count, spread, kernel)
    assert same_partition(touching(splats, np.arange(count)), by_pairs(splats))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), power=st.integers(-10, 10))
def test_groups_know_no_unit_and_no_order(seed: int, power: int) -> None:
    splats, factor = random_splats(seed, 150, 3.0), 2.0**power
    scaled = replace(splats, means=factor * splats.means, log_scales=splats.log_scales + float(np.log(factor)))
    order = np.random.default_rng(seed).permutation(150)
    groups = touching(splats, np.arange(150))
    assert same_partition(touching(splats, order), groups[order])
    assert same_partition(touching(scaled, np.arange(150)), groups)


def needle(x: float, y: float) -> Splats:
    """Return a splat of scale 1 along x, and two small ones at x and y on the axes."""
    means = torch.tensor([[0.0, 0.0, 0.0], [x, 0.0, 0.0], [0.0, y, 0.0]])
    log_scales = torch.log(torch.tensor([[1.0, 1e-3, 1e-3], [1e-3] * 3, [1e-3] * 3]))
    return Splats(means, torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 3), log_scales, torch.zeros(3))


def test_others_do_not_connect() -> None:
    row = needle(1.9, 0.1)
    assert touching(row, np.array([1, 2])).tolist() == [0, 1]  # the needle between them is not selected
    assert touching(row, np.array([1])).tolist() == [0]
    assert touching(row, np.array([], np.int64)).tolist() == []


def test_equal_places_and_extreme_sizes_are_no_trouble() -> None:
    means = torch.tensor([[0.0, 0.0, 0.0]] * 30 + [[5.0, 0.0, 0.0], [1e4, 0.0, 0.0]])
    log_scales = torch.full((32, 3), -torch.inf)
    log_scales[31] = 500.0
    splats = Splats(means, torch.zeros(32, 4), log_scales, torch.zeros(32))
    groups = touching(splats, np.arange(32))
    assert len(set(groups[:30])) == 1 and groups[30] == groups[31]  # one as large as this reaches its neighbours


def test_a_quaternion_of_zero_turns_nothing() -> None:
    still = replace(needle(1.9, 0.1), quats=torch.zeros(3, 4))
    assert touching(still, np.arange(3)).tolist() == [0, 0, 1]  # along the needle, and not beside it
