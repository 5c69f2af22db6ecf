"""Objects of an answer: groups of selected splats, their boxes and scores, and the splats of no object."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from liftcore.errors import InvalidQuery
from liftcore.query import objects as module
from liftcore.query.ask import ask
from liftcore.query.export import object_splats
from liftcore.query.objects import objects
from liftcore.query.question import Answer, Query
from liftcore.query.scene import Scene
from liftcore.query.terms import Vector
from tests.tiny_scene import AXES, SPLATS_A_CLUSTER, ply, splat_rows

from .made_up import answer_with


def of(
    scene: Scene, *clusters: int, keep: str = "all", instances: int | None = None, rows: tuple[int, ...] = ()
) -> Answer:
    """Return an answer that selected these clusters and rows; its scores rise from .5 to 1 by row."""
    answer = ask(scene, Query.of((Vector(tuple(AXES[2])),), threshold=0.5, keep=keep, instances=instances))
    selected = np.zeros(3 * SPLATS_A_CLUSTER, np.bool_)
    for cluster in clusters:
        selected[cluster * SPLATS_A_CLUSTER : (cluster + 1) * SPLATS_A_CLUSTER] = True
    selected[list(rows)] = True
    return answer_with(answer, selected=selected, scores=np.linspace(0.5, 1.0, len(selected), dtype=np.float32))


def means(scene: Scene, cluster: int) -> np.ndarray:
    return scene.splats.means.numpy()[cluster * SPLATS_A_CLUSTER : (cluster + 1) * SPLATS_A_CLUSTER]


def test_distant_single_splats_are_unassigned_and_stretch_no_box(scene: Scene) -> None:
    without_outlier = objects(scene, of(scene, 0))
    with_outlier = objects(scene, of(scene, 0, rows=(2 * SPLATS_A_CLUSTER,)))
    assert len(with_outlier.objects) == 1 and with_outlier.unassigned_splats == 1
    assert with_outlier.numbers[2 * SPLATS_A_CLUSTER] == -1
    assert with_outlier.objects[0].box == without_outlier.objects[0].box
    assert with_outlier.objects[0].share < without_outlier.objects[0].share == 1.0
    cluster = np.arange(SPLATS_A_CLUSTER)  # the same for an object of these rows
    box = module.object_box(scene.splats, cluster, np.ones(len(cluster)))
    extended = np.append(cluster, 2 * SPLATS_A_CLUSTER)
    assert module.object_box(scene.splats, extended, np.ones(len(extended))) == box
    assert module.trimmed_box(scene.splats.means.numpy()[extended], np.ones(len(extended))) != box
    merged = np.concatenate([cluster, 2 * SPLATS_A_CLUSTER + cluster])  # the box of two merged objects holds both
    assert module.object_box(scene.splats, merged, np.ones(len(merged))) == module.trimmed_box(
        scene.splats.means.numpy()[merged], np.ones(len(merged))
    )


def test_small_fragment_of_another_object_is_no_object(scene: Scene) -> None:
    count, answer = 2 * SPLATS_A_CLUSTER, of(scene, 0)
    near = np.linalg.norm(means(scene, 2) - means(scene, 2)[0], axis=1).argsort()
    fragment = count + near[:4]  # of the last cluster
    selected = answer.selected | np.isin(np.arange(len(answer.selected)), fragment)
    labels = np.repeat(np.array([0, -1, 1], np.int32), SPLATS_A_CLUSTER)
    cases = {
        "of the last": labels,
        "an object itself": np.where(np.isin(np.arange(len(labels)), fragment), 2, labels),
        "an object with two more splats": np.where(np.isin(np.arange(len(labels)), fragment[:2]), 2, labels),
        "of none": np.full(len(labels), -1, np.int32),
    }
    groupings = {}
    for name, case_labels in cases.items():
        lift = replace(
            scene.lift,
            object=torch.from_numpy(case_labels.astype(np.int32)),
            object_views=torch.zeros((3, 3), dtype=torch.int32),
        )
        groupings[name] = objects(Scene(lift, scene.splats), answer_with(answer, selected=selected))
    assert {name: len(grouping.objects) for name, grouping in groupings.items()} == {
        "of the last": 1,
        "an object itself": 2,
        "an object with two more splats": 2,
        "of none": 2,
    }
    assert groupings["of the last"].unassigned_splats == len(fragment)
    large = answer.selected | np.isin(np.arange(len(labels)), count + near[:12])
    lift = replace(scene.lift, object=torch.from_numpy(labels), object_views=torch.zeros((2, 3), dtype=torch.int32))
    assert len(objects(Scene(lift, scene.splats), answer_with(answer, selected=large)).objects) == 2


def test_keeping_the_largest_returns_it_alone_also_as_a_file(scene: Scene) -> None:
    all_objects, largest = objects(scene, of(scene, 0, 2)), objects(scene, of(scene, 0, 2, keep="largest"))
    assert largest.objects == all_objects.objects[:1]
    assert largest.unassigned_splats == all_objects.objects[1].splats
    content = b"".join(object_splats(scene, of(scene, 0, 2, keep="largest")))
    assert content == ply(splat_rows()[all_objects.numbers == 0])
    with_outlier = of(scene, 0, 2, rows=(3 * SPLATS_A_CLUSTER // 2,))
    assert b"".join(object_splats(scene, with_outlier)) == ply(splat_rows()[all_objects.numbers >= 0])


def test_instances_are_limited_by_their_scores(scene: Scene) -> None:
    all_three, two = objects(scene, of(scene, 0, 1, 2)), objects(scene, of(scene, 0, 1, 2, instances=2))
    assert len(all_three.objects) == 3 and two.unassigned_splats == SPLATS_A_CLUSTER
    assert (two.numbers[:SPLATS_A_CLUSTER] == -1).all()  # the later clusters have the higher scores
    assert two.objects == tuple(
        obj for obj in all_three.objects if obj.score > min(t.score for t in all_three.objects)
    )
    assert objects(scene, of(scene, 0, 2, instances=9)).objects == objects(scene, of(scene, 0, 2)).objects
    for count in (0, 101):
        with pytest.raises(InvalidQuery, match="instances: expected 1 to 100"):
            of(scene, 0, instances=count)


def test_objects_of_fewer_splats_are_outliers(scene: Scene) -> None:
    outlier = 5 * SPLATS_A_CLUSTER // 2
    selected = np.arange(3 * SPLATS_A_CLUSTER) < 2 * SPLATS_A_CLUSTER
    selected[:5] = False  # of the first cluster fewer splats are selected
    selected[outlier] = True
    answer = of(scene, 0)
    for size, count in ((1, 2), (SPLATS_A_CLUSTER - 5, 2), (SPLATS_A_CLUSTER - 4, 1), (SPLATS_A_CLUSTER + 1, 0)):
        grouping = objects(scene, answer_with(answer, selected=selected, min_size=size))
        assert (len(grouping.objects), grouping.numbers[outlier]) == (count, -1)
        assert grouping.unassigned_splats == selected.sum() - sum(obj.splats for obj in grouping.objects)
    none = answer_with(answer, selected=selected, min_size=SPLATS_A_CLUSTER + 1, keep="largest")
    assert objects(scene, none).objects == ()


def test_tails_of_a_thousandth_are_not_in_the_box() -> None:
    means = np.zeros((2001, 3))
    means[:, 0] = np.arange(2001)
    low, high = module.trimmed_box(means, np.ones(2001))
    assert (low[0], high[0]) == (2, 1998)  # two of 2001 below, two above
    weights = np.ones(2001)
    weights[-1] = 100.0
    assert module.trimmed_box(means, weights).high[0] == 2000
    assert module.trimmed_box(means[:1], np.ones(1)).low == (0, 0, 0)


def test_a_twentieth_of_the_weight_of_the_largest_makes_an_object(scene: Scene) -> None:
    rows = len(scene.features)
    for share, count in ((0.049, 1), (0.051, 2), (1.0, 2)):
        total_weight = torch.ones(rows)
        total_weight[2 * SPLATS_A_CLUSTER :] = share
        weighted = Scene(replace(scene.lift, total_weight=total_weight))
        assert len(objects(weighted, of(scene, 0, 2)).objects) == count
    bare = Scene(replace(scene.lift, total_weight=torch.zeros(rows)))  # without weights, all splats count the same
    grouping = objects(bare, of(scene, 0, rows=(2 * SPLATS_A_CLUSTER, 2 * SPLATS_A_CLUSTER + 1)))
    assert grouping.objects[0].splats == SPLATS_A_CLUSTER
    assert sum(obj.share for obj in grouping.objects) <= 1.0
