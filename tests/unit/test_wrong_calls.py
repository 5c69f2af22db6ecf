"""Wrong calls of new users: each error names the argument and a valid value."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import liftcore as lc
from tests.scenes import observed, random_camera, random_splats

EYE, CHANNELS = np.eye(4), 6


@dataclass(frozen=True)
class Scene:
    splats: Any
    cameras: Any
    views: Any
    result: Any
    folder: Path


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    splats = random_splats(3, 50)
    cameras = lc.Cameras([random_camera(k, name=f"v{k}") for k in range(3)])
    views = {name: observed(3, k) for k, name in enumerate(cameras)}
    result = lc.lift(splats, cameras, views, preset="row-sum")
    return Scene(splats, cameras, views, result, tmp_path_factory.mktemp("wrong"))


def splats_with(s: Scene, **overrides: Any) -> lc.Splats:
    names = ("means", "quats", "log_scales", "opacity_logits")
    return lc.Splats(**{**{name: getattr(s.splats, name) for name in names}, **overrides})


Call = Callable[[Scene], Any]
CALLS: list[tuple[str, Call]] = [
    # files
    (r"path: expected the path of a file or folder, got NoneType None", lambda s: lc.read_splats(None)),  # pyright: ignore
    (r"path: .* got int 3", lambda s: lc.read_cameras(3)),  # pyright: ignore
    (r"path: .* got list \[.*give several paths one by one", lambda s: lc.read_features(["a", "b"])),  # pyright: ignore
    (r"path: expected the path", lambda s: lc.load_lift(None)),  # pyright: ignore
    (r"nope\.ply: expected splats as PLY.* got no such file", lambda s: lc.read_splats("nope.ply")),
    (r"nope: expected a COLMAP .*transforms\.json", lambda s: lc.read_cameras("nope")),
    (r"path: expected the path", lambda s: s.result.save(None)),
    (r"expected the path of a file to write, got a folder there; name a file", lambda s: s.result.save(s.folder)),
    # splats
    (
        r"quats: expected floats of shape \[50, 4\]",
        lambda s: splats_with(s, quats=s.splats.means),
    ),
    (r"sh: expected floats of shape \[50, any, 3\]", lambda s: splats_with(s, sh=torch.ones(50, 48))),
    (r"extras\['mask'\]: expected numbers \[50\]", lambda s: splats_with(s, extras={"mask": torch.ones(3)})),
    (r"render_mode: expected classic or antialiased", lambda s: splats_with(s, render_mode="mip-nerf")),
    # cameras
    (r"pose: expected a finite 4x4 matrix, got shape \[1, 4, 4\]", lambda s: lc.Camera(EYE[None], np.eye(3), 4, 4)),
    (r"K: expected a 3x3 matrix .* got shape \[1, 3, 3\]", lambda s: lc.Camera(EYE, np.eye(3)[None], 4, 4)),
    (r"size: expected width and height, whole numbers", lambda s: lc.Camera(EYE, np.eye(3), 4, 4.5)),  # pyright: ignore
    (r"camera name: expected a text", lambda s: lc.Camera(EYE, np.eye(3), 4, 4, name=3)),  # pyright: ignore
    (r"lens: expected a Lens, or None, got 'opencv'", lambda s: lc.Camera(EYE, np.eye(3), 4, 4, lens="opencv")),  # pyright: ignore
    (r"'focal': expected one of viewmat, .*fx, fy", lambda s: s.cameras["v0"].replace(focal=3)),
    (r"fx: expected a number of pixels, got 'wide'", lambda s: s.cameras["v0"].replace(fx="wide")),
    (r"view: expected the name of a camera, got int 0; list\(cameras\)", lambda s: s.cameras[0]),
    (r"view: .* got 'v9'; nearest: v0", lambda s: s.cameras["v9"]),
    # views
    (r"labels: expected integers \[L, h, w\].* got float64", lambda s: lc.Regions(np.ones((4, 4)), np.eye(2))),
    (r"labels: expected at most 127 levels", lambda s: lc.Regions(np.zeros((128, 4, 4), np.int32), np.eye(2))),
    (r"labels: .* rows of its codebook \(0\.\.1\) or -1", lambda s: lc.Regions(np.full((4, 4), 7), np.eye(2))),
    (r"grid: expected floats \[h, w, F\], got int64", lambda s: lc.FeatureGrid(np.ones((2, 2, 2), int))),
    # lifts
    (r"splats: expected Splats, got Cameras", lambda s: lc.lift(s.cameras, s.splats, s.views)),
    (r"view 'v0': expected Regions or FeatureGrid, got Camera", lambda s: lc.lift(s.splats, s.views, s.cameras)),
    (
        r"features: expected views named like",
        lambda s: lc.lift(s.splats, s.cameras, {"x": s.views["v0"]}),
    ),
    (r"features: expected pairs of a name and a view", lambda s: lc.lift(s.splats, s.cameras, [s.views["v0"]])),  # pyright: ignore
    (
        r"stride: expected greater than or equal to 1",
        lambda s: lc.lift(s.splats, s.cameras, s.views, stride=0),
    ),
    (r"preset: expected 'default', .* got 'best'", lambda s: lc.lift(s.splats, s.cameras, s.views, "best")),
    (r"progress: expected a function", lambda s: lc.lift(s.splats, s.cameras, s.views, progress="bar")),  # pyright: ignore
    (r"on_plan: expected a function", lambda s: lc.lift(s.splats, s.cameras, s.views, on_plan=3)),  # pyright: ignore
    (r"threads: expected a whole number of one or more", lambda s: lc.LocalEngine(0)),
    (r"settings: expected LiftSettings", lambda s: lc.plan_photos(s.splats, s.cameras, "fast")),  # pyright: ignore
    # questions
    (r"query: expected a text, a list of texts, or vectors \[n, F\], got NoneType", lambda s: s.result.query(None)),
    (r"text: expected a word or a sentence, got an empty text", lambda s: s.result.query("")),
    (r"encoder: .* give encoder=, or vectors", lambda s: s.result.query("apple")),
    (r"vector: expected 6 channels", lambda s: s.result.query(np.ones(5))),
    (r"threshold: expected auto, valley", lambda s: s.result.query(np.ones(6), threshold="high")),
    (r"keep: expected one of all, largest", lambda s: s.result.query(np.ones(6), keep="some")),
    (r"splats: .* got str 'scene\.ply'; read_splats", lambda s: s.result.query(np.ones(6), splats="scene.ply")),
    (r"words: expected a list of texts, got 'ab'", lambda s: s.result.segment("ab", np.eye(2, 6), s.splats)),
    (r"words: .* 3 words and 2 vectors", lambda s: s.result.segment(list("abc"), np.eye(2, 6), s.splats)),
    (r"words: expected a list of texts", lambda s: s.result.objects(s.splats, "cat", np.eye(3, 6))),
    (
        r"its splats, got values in memory; give the splats that",
        lambda s: s.result.segment(["a", "b"], np.eye(2, 6)),
    ),
    (r"port: expected a whole number in 0\.\.65535", lambda s: s.result.show(s.splats, s.cameras, port=70_000)),
    (r"texts: expected a list of texts, got 'mug'", lambda s: lc.open_encoder("lvis").encode("mug")),
    (r"encoder: expected one of table:FILE", lambda s: lc.open_encoder("bert")),
    # renders and weights
    (r"camera: expected a Camera, got \[", lambda s: lc.render(s.splats, [s.cameras["v0"]], np.ones(50))),  # pyright: ignore
    (r"values: expected real numbers \[50\]", lambda s: lc.render(s.splats, s.cameras["v0"], np.ones(50, complex))),
    (r"alpha_cap: expected a number above 0", lambda s: lc.CompositingParams(alpha_cap=2)),
    (r"splats: .* got None; P of the scene", lambda s: lc.region_weights(s.splats, s.cameras, s.views).matrix(None)),  # pyright: ignore
    (r"weights: expected a file of splatlift-weights", lambda s: lc.RegionWeights.load("nope")),
]


@pytest.mark.parametrize(("message", "call"), CALLS, ids=[message for message, _ in CALLS])
def test_wrong_call_names_its_argument_and_what_to_give(scene: Scene, message: str, call: Call) -> None:
    with pytest.raises(lc.SplatliftError, match=message) as excinfo:
        call(scene)
    assert excinfo.value.argument and excinfo.value.expected and excinfo.value.got
    assert "\n" not in str(excinfo.value) and len(str(excinfo.value)) < 600
