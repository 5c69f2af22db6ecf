"""An answer seen from a camera: attention, and masks of what was found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from liftcore.errors import InvalidQuery, NotFound
from liftcore.io.lift_file import save_lift
from liftcore.io.lift_files import lift_files
from liftcore.query import objects as grouping
from liftcore.query import view_mask as module
from liftcore.query.ask import Answer, ask
from liftcore.query.example import Region
from liftcore.query.objects import objects
from liftcore.query.query import Query
from liftcore.query.scene import QueryScene
from liftcore.query.view_mask import view_mask
from liftcore.raster.reference import ReferenceRaster
from liftcore.scene.cameras import Cameras
from liftcore.settings import LiftSettings
from tests.api.tiny_scene import HEIGHT, SPLATS_A_CLUSTER, WIDTH, make_scene

STRAY = 2 * SPLATS_A_CLUSTER + 5  # a splat of the third cluster


@pytest.fixture
def scene(tmp_path_factory: pytest.TempPathFactory) -> QueryScene:
    """The tiny scene lifted with an opacity gain: three clusters side by side, 1.2 apart."""
    tiny, folder = make_scene(), tmp_path_factory.mktemp("look")
    for name, content in (("s.ply", tiny.splats), ("c.json", tiny.cameras), ("f.safetensors", tiny.features)):
        (folder / name).write_bytes(content)
    made = lift_files(
        folder / "s.ply", folder / "c.json", [folder / "f.safetensors"], LiftSettings.of(preset="tikhonov")
    )
    save_lift(made, folder / "scene.lift")
    return QueryScene.open(folder / "scene.lift")


def of(scene: QueryScene, *clusters: int, keep: str = "all", rows: tuple[int, ...] = ()) -> Answer:
    """An answer that selected these clusters and rows."""
    answer = ask(scene, Query((Region("left", 0, 0),), threshold=0.5, keep=keep))
    selected = torch.zeros_like(answer.selected)
    for cluster in clusters:
        selected[cluster * SPLATS_A_CLUSTER : (cluster + 1) * SPLATS_A_CLUSTER] = True
    selected[list(rows)] = True
    return replace(answer, selected=selected)


def mostly(scene: QueryScene, members: torch.Tensor) -> torch.Tensor:
    """[H, W] bool, where these splats have at least half of a ray that meets the scene, by the oracle."""
    camera, oracle = scene.cameras["middle"], ReferenceRaster(scene.splats)
    weights = oracle.render(camera, members.float()[:, None], scene.walk)[..., 0]
    row_sums = oracle.row_sums(camera, scene.walk)
    assert not ((weights / row_sums.clamp_min(1e-9) - 0.5).abs() < 1e-5).any()  # no pixel is in doubt
    return (row_sums >= 0.5) & (weights >= 0.5 * row_sums)


def test_attention_is_the_scores_rendered_with_the_lifts_gain(scene: QueryScene) -> None:
    answer, camera = of(scene, 0), scene.cameras["middle"]
    seen = view_mask(scene, answer, "middle")
    scores = torch.where(answer.seen, answer.scores, 0.0)[:, None]
    torch.testing.assert_close(seen.attention, scene.raster.render(camera, scores, scene.walk)[:, :, 0])
    torch.testing.assert_close(seen.row_sums, scene.raster.row_sums(camera, scene.walk))
    assert scene.walk.opacity_logit_scale == scene.lift.metadata.settings.render_gain == 1.2


def test_a_mask_is_where_most_of_a_ray_is_of_what_was_found(scene: QueryScene) -> None:
    answer = of(scene, 0, 1)
    seen = view_mask(scene, answer, "middle")
    assert seen.mask.shape == (HEIGHT, WIDTH)
    assert torch.equal(seen.mask, mostly(scene, answer.selected)) and seen.mask.any()
    assert "2 objects that were found" in seen.explanation


def test_strays_are_not_in_a_mask(scene: QueryScene) -> None:
    large = scene.splats.log_scales.clone()
    large[STRAY] = np.log(0.2)
    opaque = scene.splats.opacity_logits.clone()
    opaque[STRAY] = 9.0
    scene.__dict__["splats"] = replace(scene.splats, log_scales=large, opacity_logits=opaque)
    answer = of(scene, 0, rows=(STRAY,))
    assert objects(scene, answer).strays == 1
    assert (mostly(scene, answer.selected) & ~mostly(scene, of(scene, 0).selected)).any()  # it could be seen
    seen = view_mask(scene, answer, "middle")
    assert torch.equal(seen.mask, mostly(scene, of(scene, 0).selected))
    assert "1 object that was found" in seen.explanation


def test_a_view_that_sees_nothing_of_it_has_an_empty_mask(scene: QueryScene) -> None:
    shown = view_mask(scene, of(scene, 0), "middle").mask
    camera = scene.cameras["middle"]
    left = int(shown.any(dim=0).nonzero().max()) + 1  # what lies to the right of the cluster
    cut = camera.replace(width=camera.width - left, cx=camera.cx - left)
    scene.__dict__["cameras"] = Cameras((cut,))
    seen = view_mask(scene, of(scene, 0), "middle")
    assert not seen.mask.any() and (seen.row_sums >= 0.5).any()
    assert view_mask(scene, of(scene, 2), "middle").mask.any()


def test_what_hides_it_is_not_in_its_mask(scene: QueryScene) -> None:
    """The middle cluster, moved before the first one, hides it: both are found, one is seen."""
    moved = scene.splats.means.clone()
    first, second = (slice(k * SPLATS_A_CLUSTER, (k + 1) * SPLATS_A_CLUSTER) for k in range(2))
    eye = torch.from_numpy(np.linalg.inv(scene.cameras["middle"].viewmat)[:3, 3]).float()
    before = view_mask(scene, of(scene, 0), "middle").mask
    moved[second] = eye + 0.7 * (moved[first] - eye)
    scene.__dict__["splats"] = replace(scene.splats, means=moved)
    del scene.__dict__["raster"]
    hidden, shown = view_mask(scene, of(scene, 0), "middle").mask, view_mask(scene, of(scene, 1), "middle").mask
    assert shown.sum() >= before.sum() > 20
    assert hidden.sum() < 0.2 * before.sum()


def test_the_largest_object_alone_is_seen_when_asked(scene: QueryScene) -> None:
    answer = of(scene, 0, 2)
    largest = objects(scene, answer).numbers == 0
    kept = view_mask(scene, replace(answer, query=replace(answer.query, keep="largest")), "middle")
    assert torch.equal(kept.mask, mostly(scene, torch.from_numpy(largest)))
    assert 0 < int(kept.mask.sum()) < int(view_mask(scene, answer, "middle").mask.sum())


def test_nothing_found_is_an_empty_mask(scene: QueryScene) -> None:
    seen = view_mask(scene, of(scene), "middle")
    assert not seen.mask.any() and "the 0 objects that were found" in seen.explanation


def test_of_very_many_splats_strays_stay(scene: QueryScene, monkeypatch: pytest.MonkeyPatch) -> None:
    answer = of(scene, 0, rows=(STRAY,))
    monkeypatch.setattr(module, "MOST_GROUPED", answer.count)
    assert "1 object" in view_mask(scene, answer, "middle").explanation
    monkeypatch.setattr(module, "MOST_GROUPED", answer.count - 1)
    seen = view_mask(scene, answer, "middle")
    assert torch.equal(seen.mask, mostly(scene, answer.selected))
    assert f"all {answer.count} selected splats" in seen.explanation
    largest = replace(answer, query=replace(answer.query, keep="largest"))
    assert "1 object" in view_mask(scene, largest, "middle").explanation
    monkeypatch.setattr(grouping, "MOST_SPLATS", answer.count - 1)
    assert view_mask(scene, answer, "middle").mask.any()
    with pytest.raises(InvalidQuery, match="at most"):
        view_mask(scene, largest, "middle")


def test_objects_that_are_known_are_not_made_again(scene: QueryScene) -> None:
    answer, asked = of(scene, 0, 1), []
    known = objects(scene, of(scene, 1))
    seen = view_mask(scene, answer, "middle", group=lambda *both: asked.append(both) or known)
    assert torch.equal(seen.mask, mostly(scene, of(scene, 1).selected))
    assert asked == [(scene, answer)]


def test_a_view_that_is_not_there_is_told_before_anything_is_grouped(scene: QueryScene) -> None:
    def never(*_: object) -> grouping.Objects:
        raise AssertionError

    with pytest.raises(NotFound, match="middle"):
        view_mask(scene, of(scene, 0), "midle", group=never)
