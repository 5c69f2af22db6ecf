"""Wrong arguments of public functions: ONE table of call, arguments, error and the name of the argument at fault."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any

import liftcore as lc
import numpy as np
import pytest
from liftcore import evaluate, files

from tests.promises.scenes import CHANNELS, look_at, random_grid, random_scene

EYE, K = np.eye(4), np.array([[16.0, 0, 8], [0, 16, 6], [0, 0, 1]])
SCENE = random_scene(count=50, views=3)
CAMERA, VIEW = SCENE.cameras["v0"], SCENE.views["v0"]
LIFT = {"splats": SCENE.splats, "cameras": SCENE.cameras, "views": SCENE.views}
VECTORS = np.eye(2, CHANNELS)
Row = tuple[Callable[..., Any], dict[str, Any], type[lc.SplatliftError], str]


def splats(**changes: Any) -> lc.Splats:
    """Return splats of the arrays of the scene, with others in place of some."""
    arrays = {name: getattr(SCENE.splats, name) for name in ("means", "quats", "log_scales", "opacity_logits")}
    return lc.Splats(**arrays | changes)


def camera(**changes: Any) -> lc.Camera:
    return lc.Camera(**{"viewmat": EYE, "K": K, "width": 16, "height": 12, **changes})


def result_of(method: str) -> Callable[..., Any]:
    """Return a call of a method of a lift, which is made once, or of its scene."""

    def call(*arguments: Any, **keywords: Any) -> Any:
        if "lift" not in CACHE:
            CACHE["lift"] = lc.lift(*SCENE.arguments(), preset="row-sum", progress=False)
        lift = CACHE["lift"]
        return getattr(lift if hasattr(lift, method) else lift.scene(SCENE.splats), method)(*arguments, **keywords)

    return call


CACHE: dict[str, lc.LiftResult] = {}
QUERY, SEGMENT, SAVE = result_of("query"), result_of("segment"), result_of("save")
S, C, F = lc.InvalidSplats, lc.InvalidCameras, lc.InvalidFeatures
N, Q, T = lc.InvalidInput, lc.InvalidQuery, lc.InvalidSettings
ROWS: list[Row] = [
    (lc.read_splats, {"path": None}, N, "path"),
    (lc.read_splats, {"path": "nope.ply"}, S, "nope.ply"),
    (lc.read_cameras, {"path": "nope"}, C, "nope"),
    (lc.load_lift, {"path": "nope"}, lc.InvalidLift, "nope"),
    (lc.write_splats, {"path": "a.ply", "splats": "b.ply"}, S, "splats"),
    (lc.write_splats, {"path": "a.ksplat", "splats": SCENE.splats}, S, "path"),
    (lc.write_splats, {"path": "a.splat", "splats": SCENE.splats, "columns": {"a": np.ones(50)}}, S, "columns"),
    (SAVE, {"path": None}, N, "path"),
    (splats, {"means": SCENE.splats.quats}, S, "means"),
    (splats, {"opacity_logits": np.ones(49)}, S, "opacity_logits"),
    (splats, {"log_scales": np.ones((50, 3), complex)}, S, "log_scales"),
    (splats, {"extras": {"mask": np.ones(3)}}, S, "mask"),
    (splats, {"kernel": "4dgs"}, S, "kernel"),
    (camera, {"viewmat": EYE[None]}, C, "pose"),
    (camera, {"viewmat": EYE * np.nan}, C, "pose"),
    (camera, {"K": K[None]}, C, "K"),
    (camera, {"K": np.diag([0.0, 16, 1])}, C, "intrinsics"),
    (camera, {"width": 4.5}, C, "size"),
    (camera, {"name": 3}, C, "name"),
    (CAMERA.replace, {"focal": 3}, C, "focal"),
    (CAMERA.replace, {"fx": "wide"}, C, "fx"),
    (SCENE.cameras.__getitem__, {"name": "v9"}, lc.NotFound, "view"),
    (lc.Cameras, {"views": {"a": None}}, C, "cameras"),
    (lc.Cameras, {"views": [look_at(np.array([0, 0, -4.0]), "a")] * 2}, C, "cameras"),
    (lc.Regions, {"labels": np.ones((4, 4)), "codebook": np.eye(2)}, F, "labels"),
    (lc.Regions, {"labels": np.full((4, 4), 7), "codebook": np.eye(2)}, F, "labels"),
    (lc.Regions, {"labels": np.zeros((128, 4, 4), int), "codebook": np.eye(2)}, F, "labels"),
    (lc.Regions, {"labels": np.zeros((4, 4), int), "codebook": np.ones(2)}, F, "codebook"),
    (lc.Regions, {"labels": np.zeros((4, 4), int), "codebook": np.eye(2) * np.nan}, F, "codebook"),
    (lc.FeatureGrid, {"grid": np.ones((2, 2, 2), int)}, F, "grid"),
    (lc.FeatureGrid, {"grid": np.full((1, 1, 2), np.inf)}, F, "grid"),
    (lc.FeatureGrid, {"grid": np.full((1, 1, 2), 1e30)}, F, "grid"),
    *((call, LIFT | {name: value}, error, argument)
      for call in (lc.plan, lc.region_weights)
      for name, value, error, argument in (
          ("splats", "scene.ply", S, "splats"), ("views", {"x": VIEW}, F, "features"), ("threads", 0, T, "threads"),
          ("preset", "best", T, "preset"),
      )),
    *((lc.lift, LIFT | {name: value}, error, argument)
      for name, value, error, argument in (
          ("splats", "scene.ply", S, "splats"), ("cameras", "sparse/0", C, "cameras"),
          ("views", "pack.safetensors", F, "features"), ("views", [VIEW], F, "features"),
          ("views", {"x": VIEW}, F, "features"), ("views", {"v0": CAMERA}, F, "v0"),
          ("views", {"v0": VIEW, "v1": lc.FeatureGrid(np.ones((2, 2, 9)))}, F, ""),
          ("threads", 0, T, "threads"), ("threads", True, T, "threads"), ("device", "tpu", T, "device"),
          ("preset", "best", T, "preset"), ("stride", 0, T, "stride"), ("robust", "very", T, "robust"),
      )),
    (lc.lift, LIFT | {"progress": "bar"}, T, "progress"),
    (lc.lift, LIFT | {"on_plan": 3}, T, "on_plan"),
    (lc.lift, LIFT | {"engine": "local"}, T, "engine"),
    (lc.LiftSettings.of, {"no_setting": 1}, T, "no_setting"),
    (lc.LocalEngine, {"threads": 0}, T, "threads"),
    (lc.open_engine, {"name": "slurm"}, T, "engine"),
    (lc.CompositingParams, {"alpha_cap": 2}, T, "alpha_cap"),
    (lc.render, {"splats": SCENE.splats, "camera": [CAMERA], "values": np.ones(50)}, C, "camera"),
    (lc.render, {"splats": SCENE.splats, "camera": CAMERA, "values": np.ones(49)}, T, "values"),
    (QUERY, {"positives": None}, Q, "query"),
    (QUERY, {"positives": ""}, Q, "text"),
    (QUERY, {"positives": np.ones(5)}, Q, "vector"),
    (QUERY, {"positives": VECTORS, "threshold": "high"}, Q, "threshold"),
    (QUERY, {"positives": VECTORS, "splats": "scene.ply"}, S, "splats"),
    (result_of("render"), {"view": CAMERA, "channel": "x"}, Q, "channel"),
    (result_of("export"), {"path": "a.ply", "source": 3.5}, Q, "source"),
    (SEGMENT, {"words": "ab", "vectors": VECTORS}, Q, "words"),
    (lc.open_encoder, {"spec": "bert"}, lc.SplatliftError, "encoder"),
    (lc.pack_folder, {"folder": None, "out": "x", "kind": "npy"}, N, "folder"),
    (lc.pack_folder, {"folder": ".", "out": "x", "kind": "mask"}, N, "kind"),
    (lc.pack_folder, {"folder": ".", "out": "x", "kind": "npy", "unlabelled": 3}, N, "unlabelled"),
    (lc.pack_folder, {"folder": ".", "out": "x", "kind": "npy", "normalised": "maybe"}, N, "normalised"),
    (lc.pack_folder, {"folder": ".", "out": "x", "kind": "prompts", "text_space": "x"}, N, "text_space"),
    (lc.pack_folder, {"folder": ".", "out": "x", "kind": "masks", "photos": "."}, N, "encoder"),
    (lc.encode_images, {"images": [], "out": "x", "encoder": "timm:resnet18"}, N, "images"),
    (lc.retag_pack, {"pack": "nope", "out": "x", "names": {"foo": "x"}}, N, "names"),
    (lc.lift_files, {"splats": "a", "cameras": "b", "features": "c"}, F, "features"),
    (lc.lift_files, {"splats": "a", "cameras": "b", "features": ["c"], "settings": {}}, T, "settings"),
    (evaluate.SceneFiles, {"splats": None, "cameras": "b", "features": ()}, N, "splats"),
    (evaluate.compare_speeds, {"files": "scene.ply"}, N, "files"),
    (evaluate.evaluate_lift, {"lift": "", "labels": "x"}, N, "lift"),
    (lc.RegionWeights.load, {"path": "nope"}, N, "weights"),
    (evaluate.inspect_file, {"path": ".", "kind": "foo"}, N, "kind"),
    (files.check_output, {"path": "new.npy", "inputs": [], "kind": "foo"}, N, "kind"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("call", "arguments", "error", "argument"), ROWS, ids=[f"{number} {row[3]}" for number, row in enumerate(ROWS)]
)
def test_wrong_argument_is_named_in_one_line(
    call: Callable[..., Any],
    arguments: dict[str, Any],
    error: type[lc.SplatliftError],
    argument: str,
    tmp_path: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error) as error_info:
        call(*arguments.values()) if call == SCENE.cameras.__getitem__ else call(**arguments)
    refusal = error_info.value
    assert argument in refusal.argument and refusal.expected and refusal.got
    assert "\n" not in str(refusal) and len(str(refusal)) < 900
    copy = pickle.loads(pickle.dumps(refusal))
    assert type(copy) is type(refusal) and (str(copy), copy.nearest) == (str(refusal), refusal.nearest)
    assert not list(tmp_path.iterdir()), "nothing is written"


def test_grids_and_regions_may_stand_beside_each_other() -> None:
    """Views of both kinds are one lift, so that a refusal of the table is of the fault that it names."""
    views = SCENE.views | {"v1": random_grid(np.random.default_rng(0))}
    result = lc.lift(SCENE.splats, SCENE.cameras, views, preset="row-sum", progress=False)
    assert result.views == ("v0", "v1", "v2")
