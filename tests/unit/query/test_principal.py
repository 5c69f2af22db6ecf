"""Principal components as colours."""

from __future__ import annotations

import torch

from liftcore.query import principal
from liftcore.query.principal import principal_colours


def test_groups_of_features_get_colours_of_their_own_the_same_at_every_run() -> None:
    generator = torch.Generator().manual_seed(1)
    group = torch.arange(3000) % 3
    features = (torch.eye(16)[group] + 0.02 * torch.randn(3000, 16, generator=generator)).half()
    features[-1] = 0
    first, again = (principal_colours(features, torch.ones(3000)) for _ in range(2))
    assert torch.equal(first, again)
    assert first.min() >= 0 and first.max() <= 1 and not first[-1].any()
    means = torch.stack([first[:-1][group[:-1] == k].mean(dim=0) for k in range(3)])
    assert torch.pdist(means).min() > 0.4


def test_fewer_than_three_channels_and_no_evidence_are_fine() -> None:
    assert principal_colours(torch.rand(10, 2), torch.ones(10)).shape == (10, 3)
    assert not principal_colours(torch.rand(10, 4), torch.zeros(10)).any()


def test_very_many_channels_take_a_smaller_sample(monkeypatch) -> None:
    drawn, draw = [], principal._draw
    monkeypatch.setattr(principal, "SAMPLE_FLOATS", 6400)
    monkeypatch.setattr(principal, "_draw", lambda odds, count: drawn.append(count) or draw(odds, count))
    assert principal_colours(torch.rand(50, 640), torch.ones(50)).max() > 0
    assert principal_colours(torch.rand(50, 6401), torch.ones(50)).shape == (50, 3)
    assert drawn == [10, 3]
