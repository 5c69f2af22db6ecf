"""Who takes part, and at which sizes."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from tests.benchmarks.peers.dense_numba import DenseNumba
from tests.benchmarks.peers.metal_gauss import MetalGauss
from tests.benchmarks.peers.ours import Ours
from tests.benchmarks.peers.side_by_side import Axis, Sizes
from tests.benchmarks.peers.torch_autograd import TorchAutograd
from tests.benchmarks.peers.work import Size

if TYPE_CHECKING:
    from tests.benchmarks.peers.peer import Peer

PEERS: tuple[Peer, ...] = (Ours(), DenseNumba(), TorchAutograd(), MetalGauss())

TINY = Size(splats=500, width=64, height=48, views=1, channels=4)  # to load kernels and start threads
BASE = Size(splats=20_000, width=200, height=150, views=4, channels=64)

SIZES = Sizes(
    small=Size(splats=5_000, width=100, height=75, views=2, channels=8),
    base=BASE,
    large=Size(splats=200_000, width=640, height=480, views=2, channels=512),
    axes=(
        Axis("splats", tuple(replace(BASE, splats=1_000 * n) for n in (5, 20, 80, 320)), lambda size: size.splats),
        Axis(
            "pixels",
            tuple(replace(BASE, width=4 * n, height=3 * n) for n in (25, 50, 100, 200)),
            lambda size: size.width * size.height,
        ),
        Axis("views", tuple(replace(BASE, views=n) for n in (1, 4, 12, 32)), lambda size: size.views),
        Axis(
            "channels", tuple(replace(BASE, channels=n) for n in (4, 16, 64, 256, 1024)), lambda size: size.channels
        ),
    ),
)
