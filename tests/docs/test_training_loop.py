"""The five lines for a training loop, on tensors as gsplat trains them, give what the same scene gives from files."""

import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import liftcore as lc
from liftcore.features.pack import write_pack
from liftcore.io.inria import write_inria_cameras
from liftcore.io.ply import write_splats

from .readme import PYTHON, blocks

WIDTH, HEIGHT, CHANNELS = 64, 48, 12


@pytest.fixture
def loop() -> dict[str, Any]:
    """What a training loop holds: parameters, poses and photos of two clouds of splats, and an image encoder."""
    random = torch.Generator().manual_seed(5)
    means = 0.25 * torch.randn(400, 3, generator=random)
    means[:200, 0] -= 0.8
    means[200:, 0] += 0.8
    params: dict[str, Any] = {
        "means": means,
        "quats": 3 * torch.randn(400, 4, generator=random),  # unnormalised, as they are trained
        "log_scales": torch.full((400, 3), -2.6) + 0.2 * torch.randn(400, 3, generator=random),
        "opacity_logits": torch.full((400,), 1.5),
    }
    names = dict(torch.nn.ParameterDict(params).items())
    viewmats, Ks = torch.eye(4).repeat(5, 1, 1), torch.eye(3).repeat(5, 1, 1)
    viewmats[:, 0, 3], viewmats[:, 2, 3] = torch.linspace(-0.5, 0.5, 5), 4.0
    Ks[:, 0, 0] = Ks[:, 1, 1] = 60.0
    Ks[:, 0, 2], Ks[:, 1, 2] = WIDTH / 2, HEIGHT / 2
    splats = lc.Splats(**params)
    colours = torch.where(means[:, :1] < 0, torch.tensor([1.0, 0.2, 0.1]), torch.tensor([0.1, 0.3, 1.0]))
    views = [f"{view:04d}" for view in range(5)]
    poses: Any = list(zip(views, viewmats, Ks, strict=True))
    torch.manual_seed(2)
    net = torch.nn.Sequential(
        torch.nn.Conv2d(3, 16, 3, stride=2, padding=1), torch.nn.Tanh(), torch.nn.Conv2d(16, CHANNELS, 1)
    )

    def encode(photo: torch.Tensor) -> torch.Tensor:
        """[h, w, F] of a photo [H, W, 3], with gradients as a network gives them."""
        return net(photo.permute(2, 0, 1)[None])[0].permute(1, 2, 0)

    photos = [(name, lc.render(splats, lc.Camera(viewmat, K, WIDTH, HEIGHT), colours)) for name, viewmat, K in poses]
    return names | {
        "poses": poses, "photos": photos, "encode": encode, "width": WIDTH, "height": HEIGHT, "name": views[2],
    }  # fmt: skip


def test_tensors_of_a_training_loop_lift_as_their_files_do(loop: dict[str, Any], tmp_path: Path) -> None:
    assert all(loop[name].requires_grad for name in ("means", "quats", "log_scales", "opacity_logits"))
    (example,) = (block for block in blocks(PYTHON, "python") if "lc.Splats(" in block)
    five = example.splitlines()[2:]
    assert len(five) == 5
    exec("\n".join([example.splitlines()[0], *five[:4]]), loop)
    assert inspect.isgenerator(loop["views"])
    features = loop["result"].features.float()
    loop["text_vectors"] = features[loop["means"][:, 0].detach() < 0].mean(dim=0)
    exec(five[4], loop)

    write_splats(loop["splats"], tmp_path / "scene.ply")
    named = [lc.Camera(viewmat, K, WIDTH, HEIGHT, name=name) for name, viewmat, K in loop["poses"]]
    write_inria_cameras(lc.Cameras(tuple(named)), tmp_path / "cameras.json")
    grids = {name: lc.FeatureGrid(loop["encode"](photo)) for name, photo in loop["photos"]}
    write_pack(tmp_path / "features.safetensors", grids, {})
    filed = lc.lift(
        lc.read_splats(tmp_path / "scene.ply"), lc.read_cameras(tmp_path / "cameras.json"),
        lc.read_features(tmp_path / "features.safetensors"),
    )  # fmt: skip
    assert torch.allclose(filed.features.float(), features, atol=2e-3)  # packs and poses are rounded, values are not
    assert torch.equal(filed.seen, loop["result"].seen)

    columns = np.nonzero(np.asarray(loop["mask"]))[1]
    assert len(columns) > 20 and columns.max() < WIDTH / 2  # the cloud on the left was asked for
    assert loop["means"].grad is None
