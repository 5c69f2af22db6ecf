"""Extremes of features: their length, their number, their maps; and what is refused."""

from __future__ import annotations

import math

import numpy as np
import torch

from liftcore.features.views import FeatureGrid, Regions, ViewFeatures
from liftcore.scene.cameras import Cameras
from liftcore.scene.splats import Kernel
from liftcore.settings import LiftSettings
from tests.benchmarks.stability.case import GAUSSIAN, Extreme
from tests.benchmarks.stability.lifts import AWAY, HEIGHT, WIDTH, Task, cloud, lifted, refused, run
from tests.scenes import splats_at

FLOAT16 = {"dtype": "float16"}
STEP = 1e-3  # of the longest value, for what is stored in float16
SUM = 2e-6  # of the longest value, for what is stored in float32
LARGEST_I16 = 32_767


def checkerboard(rows: int = 5, channels: int = 9, scale: float = 1.0, dtype: torch.dtype = torch.float32) -> Regions:
    """Regions of 4 x 4 pixels that read ``rows`` random vectors, whose largest value is ``scale``."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    labels = torch.tensor((y // 4 * 4 + x // 4) % rows, dtype=torch.int32)[None]
    vectors = np.random.default_rng(rows).uniform(-1, 1, (rows, channels))
    return Regions(labels, torch.tensor(vectors / np.abs(vectors).max() * scale).to(dtype))


def _zero_row() -> Regions:
    observation = checkerboard(3)
    observation.codebook[1] = 0
    return observation


def _labelled(labels: np.ndarray, rows: int, channels: int = 4) -> Regions:
    """Labels [h, w] over random vectors."""
    vectors = np.random.default_rng(rows).uniform(-1, 1, (rows, channels))
    return Regions(torch.tensor(labels, dtype=torch.int32)[None], torch.tensor(vectors, dtype=torch.float32))


def _one_pixel(label: int = 1, rows: int = 4) -> Regions:
    labels = np.full((HEIGHT, WIDTH), -1)
    labels[6, 8] = label
    return _labelled(labels, rows)


def _cancelling() -> Regions:
    """Two vectors, one the other's negative up to a thousandth, in turn on all pixels."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    book = torch.full((2, 6), 1e4)
    book[1] *= -(1 - 1e-3)
    return Regions(torch.tensor((x + y) % 2, dtype=torch.int32)[None], book)


def _task(observation: ViewFeatures, **settings: object) -> Task:
    return Task({"v0": observation}, settings={"dtype": "float32", **settings})


LENGTHS: tuple[Extreme, ...] = (
    *(
        lifted(
            f"F = {channels}",
            "a weighted mean of the rows",
            lambda channels=channels: _task(checkerboard(channels=channels)),
            bound=SUM,
        )
        for channels in (1, 8_192)
    ),
    *(
        lifted(
            f"values to {scale:g}, given in {str(given).removeprefix('torch.')}, to be stored in float16",
            "a mean is no longer than its inputs",
            lambda scale=scale, given=given: Task({"v0": checkerboard(5, 40, scale, given)}, settings=FLOAT16),
            lambda made, stored=stored: made.features.dtype == stored,
            bound=STEP if stored == torch.float16 else SUM,
            told="float16 does not hold" if stored == torch.float32 else "",
            kernels=GAUSSIAN,
        )
        for scale, given, stored in (
            (65_504.0, torch.float16, torch.float16),
            (65_504.0, torch.float32, torch.float16),
            (70_000.0, torch.float32, torch.float32),
            (1e14, torch.float32, torch.float32),
            (1e-4, torch.float16, torch.float32),
            (1e-30, torch.float32, torch.float32),
        )
    ),
    lifted(
        "values of 1e-40, below the normal numbers of float32",
        "a weighted mean",
        lambda: _task(checkerboard(scale=1e-40)),
        bound=1e-3,
        kernels=GAUSSIAN,
    ),
    lifted(
        "a zero row in the codebook",
        "it pulls means towards zero; it has no direction",
        lambda: _task(_zero_row()),
        bound=SUM,
        told="codebook rows are zero",
    ),
    lifted(
        "a codebook of zeros",
        "zero, with no agreement",
        lambda: _task(Regions(checkerboard(3).labels, torch.zeros(3, 7))),
        lambda made: float(made.agreement.max()) == 0,
        bound=0.0,
        told="codebook rows are zero",
    ),
    lifted(
        "vectors that cancel: +1e4 and -9990 in turn",
        "means far shorter than the inputs, to their digits",
        lambda: _task(_cancelling()),
        lambda made: float(made.agreement.min()) < 0.2,
        bound=SUM,
    ),
)

MAPS: tuple[Extreme, ...] = (
    lifted("a mask of one pixel", "what its ray meets has its feature", lambda: _task(_one_pixel()), bound=SUM),
    lifted(
        "one label on the whole image",
        "every splat that is seen has the same feature",
        lambda: _task(_labelled(np.zeros((HEIGHT, WIDTH)), 1)),
        lambda made: bool((made.features[made.seen] - made.features[made.seen][0]).abs().max() < 1e-6),
        bound=SUM,
    ),
    lifted(
        "labels of 1 x 1 pixel",
        "the same",
        lambda: _task(_labelled(np.zeros((1, 1)), 1)),
        lambda made: float(made.agreement[made.seen].min()) > 1 - 1e-6,
        bound=SUM,
    ),
    lifted(
        "a region a pixel",
        "the dense map",
        lambda: _task(_labelled(np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH), HEIGHT * WIDTH)),
        bound=SUM,
    ),
    lifted(
        "labels of 32,766 and 32,767, the last of int16",
        "as with small numbers",
        lambda: _task(_labelled(LARGEST_I16 - np.indices((HEIGHT, WIDTH)).sum(axis=0) % 2, LARGEST_I16 + 1)),
        bound=SUM,
        kernels=GAUSSIAN,
        told="are read by no label",
    ),
    lifted(
        "a label of 32,768, the first beyond int16",
        "as with small numbers",
        lambda: _task(_one_pixel(LARGEST_I16 + 1, LARGEST_I16 + 2)),
        bound=SUM,
        kernels=GAUSSIAN,
        told="are read by no label",
    ),
    lifted(
        "a view without any label",
        "no feature; the evidence is as it was",
        lambda: _task(_labelled(np.full((3, 4), -1), 2)),
        lambda made: not bool(made.seen.any()) and bool((made.evidence > 0).any()),
        bound=0.0,
        told="no labelled ray reached any splat",
    ),
    lifted(
        "a view that sees nothing beside one that does",
        "as without it",
        lambda: Task({AWAY: checkerboard(), "v0": checkerboard()}),
        lambda made: bool(made.seen.any()),
        bound=SUM,
        told="1 of 2 views meet no splat: away",
    ),
    lifted(
        "views that all see nothing",
        "no feature",
        lambda: Task({AWAY: checkerboard()}),
        lambda made: not bool(made.seen.any()),
        bound=0.0,
        told="share their frame",
    ),
    lifted(
        "a splat that one ray alone meets",
        "the feature of that ray",
        lambda: Task(
            {"v0": _labelled(np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH), HEIGHT * WIDTH)},
            splats_at([(0.125, 0.125, 0.0)], -12.0, logits=-4.0),
        ),
        lambda made: abs(float(made.agreement[0]) - 1) < 1e-6,
        bound=SUM,
        kernels=GAUSSIAN,
    ),
    lifted(
        "a grid of 1 x 1 cell",
        "its vector everywhere",
        lambda: _task(FeatureGrid(torch.ones(1, 1, 6))),
        lambda made: bool((made.features[made.seen] - 1).abs().max() < 1e-6),
        bound=SUM,
    ),
    lifted(
        "a grid finer than the pixels",
        "the cells nearest to pixel centres",
        lambda: _task(FeatureGrid(torch.rand(50, 70, 6, generator=torch.manual_seed(0)))),
        bound=SUM,
    ),
    *(
        lifted(
            f"squared weights and a gain of {gain:g}",
            "the mean under polarised opacities",
            lambda gain=gain: _task(checkerboard(), power=2, lift_gain=gain),
            bound=SUM,
        )
        for gain in (0.01, 8.0, 16.0)
    ),
    lifted(
        "weights of 1e-20, squared (DBS)",
        "a mean over weights of 1e-40",
        lambda: Task(
            {"v0": checkerboard()},
            splats_at([(0.0, 0.0, 0.0)], 0.0, logits=-46.0, kernel=Kernel.BETA),
            {"dtype": "float32", "power": 2},
        ),
        lambda made: float(made.evidence[0]) < 1e-15,
        told="where float32 loses digits",
        kernels=(Kernel.BETA,),
        bound=SUM,
    ),
)

REFUSALS: tuple[Extreme, ...] = (
    *(
        refused(
            name,
            "no splat",
            lambda more=more: splats_at(**{"means": [(0.0, 0.0, 2.0)], **more}),
            "finite values",
            kernels=GAUSSIAN,
        )
        for name, more in (
            ("an opacity logit of nan", {"logits": math.nan}),
            ("a log scale of inf", {"log_scales": math.inf}),
            ("a place of inf", {"means": [(0.0, math.inf, 2.0)]}),
        )
    ),
    refused("no splats (P = 0)", "no X", lambda: splats_at(np.zeros((0, 3))), "empty scene", kernels=GAUSSIAN),
    refused("no views", "no rays", lambda: Cameras(()), "at least one view", kernels=GAUSSIAN),
    refused(
        "values of 1e30",
        "squares that float32 does not hold",
        lambda: run(_task(checkerboard(scale=1e30)), cloud()),
        "finite values within",
        kernels=GAUSSIAN,
    ),
    refused(
        "a label beyond the codebook",
        "no row to read",
        lambda: run(_task(_labelled(np.full((2, 2), 4), 4)), cloud()),
        "rows of its codebook",
        kernels=GAUSSIAN,
    ),
    refused(
        "a gain of nought",
        "every opacity a half",
        lambda: LiftSettings.of(lift_gain=0),
        "greater than 0",
        kernels=GAUSSIAN,
    ),
)
