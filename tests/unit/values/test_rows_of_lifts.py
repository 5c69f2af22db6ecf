"""Subsets of a lift, a lift in another frame, and lifts queried with other splats."""

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

import liftcore as lc
from liftcore.values.lift import InputFile
from liftcore.values.lift_file import found_input
from tests.scenes import random_camera, random_splats, write_scene

MATRIX = np.array([[0.0, -2, 0, 1], [2, 0, 0, 2], [0, 0, 2, 3]])


@pytest.fixture(scope="module")
def scene() -> tuple[lc.Splats, lc.Cameras, lc.LiftResult]:
    """Return a lift with clusters and objects from masks."""
    splats = random_splats(4, 300)
    cameras = lc.Cameras([random_camera(k, 48, 40, name=f"v{k}") for k in range(6)])
    sides = splats.means[:, 0] > 0
    views = {}
    for name, camera in cameras.items():
        image = lc.render(splats, camera, torch.stack([sides, ~sides], dim=1).float())
        masks = torch.stack([(image[..., k] > image[..., 1 - k]) for k in range(2)])
        views[name] = lc.Regions.from_masks(masks, np.eye(2, 6, dtype=np.float32))
    return splats, cameras, lc.lift(splats, cameras, views, aggregation=True, aggregation_cluster_size=5)


def test_rows_of_a_lift_are_its_columns_and_answer_as_those_of_the_whole(scene, tmp_path: Path) -> None:
    splats, _, result = scene
    keep = splats.means[:, 0] > -0.2
    subset, full = result[keep], result
    for name in ("features", "total_weight", "has_feature", "confidence"):
        assert torch.equal(getattr(subset, name), getattr(full, name)[keep]), name
    assert len(subset) == len(splats[keep]) == int(keep.sum())
    answer = subset.query(np.eye(1, 6), splats=splats[keep], threshold=0.5)
    np.testing.assert_array_equal(answer.selected, full.query(np.eye(1, 6), threshold=0.5).selected[keep.numpy()])
    subset.save(tmp_path / "some.lift.safetensors")
    copy = lc.load_lift(tmp_path / "some.lift.safetensors")
    assert torch.equal(copy.features, subset.features) and copy.diagnostics["cropped_from"] == 300
    assert copy[::2].diagnostics["cropped_from"] == 300 and copy.metadata.splats.path == ""


def test_objects_and_clusters_without_splats_go_and_the_others_are_numbered_anew(scene) -> None:
    splats, _, result = scene
    assert result.object is not None and result.object_views is not None and len(result.object_views) >= 2
    last = len(result.object_views) - 1
    for labels, table in (("object", "object_views"), ("cluster", "cluster_features")):
        row_labels = getattr(result, labels)
        subset = result[row_labels != 0]
        numbers = torch.unique(getattr(subset, labels))
        assert numbers[numbers >= 0].tolist() == list(range(len(getattr(subset, table))))
        subset_labels = row_labels[row_labels != 0]
        mapped = getattr(result, table)[subset_labels[subset_labels >= 0].long()]
        assert torch.equal(mapped, getattr(subset, table)[getattr(subset, labels)[subset_labels >= 0].long()])
    mask = result.object == last
    assert len(result[mask].scene(splats[mask]).tree().objects) == 1


def test_a_lift_moves_with_its_splats(scene) -> None:
    splats, _, result = scene
    transformed = result.transformed(MATRIX)
    assert torch.equal(transformed.features, result.features) and transformed.metadata.poses == ""
    answer = transformed.query(np.eye(1, 6), splats=splats.transformed(MATRIX))
    assert np.array_equal(answer.selected, result.query(np.eye(1, 6), splats=splats).selected)
    with pytest.raises(lc.InvalidSplats, match=r"row for row, got others: .*result\.transformed"):
        transformed.query(np.eye(1, 6), splats=splats)


CHANGES: dict[str, Callable[[lc.Splats], lc.Splats]] = {
    "in another order": lambda splats: splats[::-1],
    "moved": lambda splats: splats.transformed([[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0]]),
    "turned": lambda splats: splats.transformed([[1, 0, 0, 0], [0, 0.8, -0.6, 0], [0, 0.6, 0.8, 0]]),
}


@pytest.mark.parametrize("kind", CHANGES)
def test_splats_that_are_not_those_of_the_lift_are_refused(scene, kind: str) -> None:
    splats, _, result = scene
    for other, lift in ((CHANGES[kind](splats), result), (CHANGES[kind](splats)[:200], result[:200])):
        with pytest.raises(lc.InvalidSplats, match=r"splats: expected the .* Splats that were lifted, row for row"):
            lift.query(np.eye(1, 6), splats=other)
        with pytest.raises(lc.InvalidSplats, match="row for row"):
            lift.scene(other)


def test_lift_of_files_knows_its_splats_in_memory(tmp_path: Path) -> None:
    splats, cameras, pack = write_scene(tmp_path, 3)
    loaded = lc.read_splats(splats)
    result = lc.lift(loaded, lc.read_cameras(cameras), lc.read_features(pack), preset="row-sum")
    result.save(tmp_path / "lift.safetensors")
    copy = lc.load_lift(tmp_path / "lift.safetensors")
    copy.query(np.eye(1, 6), splats=loaded)
    with pytest.raises(lc.InvalidSplats, match="row for row"):
        copy.query(np.eye(1, 6), splats=loaded[::-1])
    with pytest.raises(lc.InvalidSplats, match=r"got 49 splats; crop a lift as its splats"):
        copy.query(np.eye(1, 6), splats=loaded[1:])


@pytest.mark.parametrize("place", ["blobs/{digest}.ply", "lifts/renamed.ply"])
def test_an_input_is_found_by_its_digest_in_a_store_and_beside(scene, place: str, tmp_path: Path) -> None:
    digest = hashlib.sha256(b"splats").hexdigest()
    stored = tmp_path / place.format(digest=digest)
    stored.parent.mkdir()
    stored.write_bytes(b"splats")
    absent = InputFile(path="/nowhere/splats.ply", sha256=digest)
    assert found_input("splats", absent, scene[2].metadata, tmp_path / "lifts" / "x.safetensors") == stored
