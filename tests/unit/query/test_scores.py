"""Scores against their dense definitions in float64."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from liftcore.query.scores import cosines_about, mean_direction, norms_of


@given(
    seed=st.integers(0, 99),
    cone=st.sampled_from([0.0, 0.5, 0.95]),
    dtype=st.sampled_from([torch.float16, torch.float32]),
)
@settings(max_examples=30, deadline=None)
def test_cosines_about_the_mean_equal_their_definition(seed: int, cone: float, dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(seed)
    features = (torch.randn(400, 32, generator=generator) + cone * 20 * torch.ones(32)).to(dtype)
    features[7] = 0
    rows = features.numpy()
    norms, weights = norms_of(rows), torch.rand(400, generator=generator)
    unit = torch.nn.functional.normalize(features.double(), dim=1)
    shares = weights.double() * torch.from_numpy(norms > 0)
    mean = (unit * shares[:, None]).sum(dim=0) / shares.sum()
    actual = mean_direction(rows, norms, weights.numpy())
    np.testing.assert_allclose(actual, mean.numpy(), atol=1e-5)
    examples = unit[:3].float()
    expected = torch.nn.functional.cosine_similarity((unit - mean)[:, None], (unit[:3] - mean)[None], dim=2)
    about = cosines_about(rows, norms, actual, examples.numpy())
    np.testing.assert_allclose(about[norms > 0], expected.numpy()[norms > 0], atol=3e-3)
