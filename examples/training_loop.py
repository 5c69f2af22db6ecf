# pyright: strict
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# numpy, scipy and torch leave types of what they compute open
"""Lift within a training loop: tensors as gsplat's trainer has them, and one map of features a photo.

python examples/training_loop.py
"""

import math
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

import liftcore as lc

SIZE = 64  # pixels of a photo's side
VIEWS = 6


def trained() -> dict[str, Tensor]:
    """Return two blobs, red and green, as parameters of a training: logarithms of scales, logits of opacities."""
    noise = torch.Generator().manual_seed(0)
    side = torch.arange(400) % 2
    means = torch.randn(400, 3, generator=noise) * 0.15 + torch.stack([side * 1.2 - 0.6, side * 0, side * 0], 1)
    colours = torch.stack([1.0 - side, side * 1.0, side * 0.0], 1)
    return {
        "means": means,
        "quats": torch.nn.functional.normalize(torch.randn(400, 4, generator=noise), dim=1),
        "scales": torch.full((400, 3), math.log(0.05)),
        "opacities": torch.full((400,), 2.0),
        "sh0": (colours[:, None] - 0.5) / 0.28209479177387814,
        "shN": torch.zeros(400, 0, 3),
    }


def poses() -> dict[str, lc.Camera]:
    """Return cameras on an arc in front of the blobs."""
    cameras: dict[str, lc.Camera] = {}
    K = torch.tensor([[80.0, 0, SIZE / 2], [0, 80, SIZE / 2], [0, 0, 1]])
    for number in range(VIEWS):
        angle = (number - VIEWS / 2) * 0.15
        c2w = torch.eye(4)
        c2w[:3, :3] = torch.tensor(
            [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
        )
        c2w[:3, 3] = c2w[:3, :3] @ torch.tensor([0.0, 0.0, 3.0])
        name = f"photo{number}"
        cameras[name] = lc.Camera.from_camera_to_world(c2w, K, SIZE, SIZE, convention="opengl", name=name)
    return cameras


def encode(photo: Tensor) -> Tensor:
    """Return features [h, w, 4] of a photo [H, W, 3]; in place of a network, its colours at every fourth pixel."""
    return torch.cat([photo[::4, ::4], photo[::4, ::4].sum(2, keepdim=True)], 2)


def main() -> None:
    """Lift, and query the feature of the red blob."""
    parameters = trained()
    splats = lc.Splats.from_gsplat(**parameters, activated=False)  # pyright: ignore[reportArgumentType]
    cameras = poses()
    colours = (parameters["sh0"][:, 0] * 0.28209479177387814 + 0.5).clamp(0, 1)

    def features() -> Iterator[tuple[str, lc.FeatureGrid]]:  # one map in memory at a time
        for name, camera in cameras.items():
            photo = lc.render(splats, camera, colours)  # in a training loop, the real photo
            yield name, lc.FeatureGrid(encode(photo))

    with torch.inference_mode():  # as in evaluation; the result is the same
        result = lc.lift(splats, cameras, features())
    answer = result.query(encode(torch.tensor([[[1.0, 0.0, 0.0]]]))[0, 0])
    red = np.arange(400) % 2 == 0
    correct, wrong = int((answer.selected & red).sum()), int((answer.selected & ~red).sum())
    print(f"{correct} of {int(red.sum())} red splats, {wrong} others")


if __name__ == "__main__":
    main()
