"""What an answer found, thing by thing."""

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
from liftcore.query.terms import Region
from tests.api.tiny_scene import SPLATS_A_CLUSTER, ply, splat_rows

from .made_up import answer_with


def of(
    scene: Scene, *clusters: int, keep: str = "all", instances: int | None = None, rows: tuple[int, ...] = ()
) -> Answer:
    """An answer that selected these clusters and rows, with scores of .5 and more the later they stand."""
    answer = ask(scene, Query.of((Region("left", 0, 2),), threshold=0.5, keep=keep, instances=instances))
    selected = np.zeros(3 * SPLATS_A_CLUSTER, np.bool_)
    for cluster in clusters:
        selected[cluster * SPLATS_A_CLUSTER : (cluster + 1) * SPLATS_A_CLUSTER] = True
    selected[list(rows)] = True
    return answer_with(answer, selected=selected, scores=np.linspace(0.5, 1.0, len(selected), dtype=np.float32))


def means(scene: Scene, cluster: int) -> np.ndarray:
    return scene.splats.means.numpy()[cluster * SPLATS_A_CLUSTER : (cluster + 1) * SPLATS_A_CLUSTER]


@pytest.mark.parametrize("weight_by", ["evidence", "confidence"])
def test_clusters_that_are_apart_are_objects_with_their_boxes(weight_by: str, scene: Scene) -> None:
    confidence = torch.rand(len(scene.features), generator=torch.Generator().manual_seed(0))
    answer = of(scene, 0, 2)
    answer = answer_with(answer, weight_by=weight_by)
    found = objects(Scene(replace(scene.lift, confidence=confidence), scene.splats), answer)
    assert len(found.objects) == 2 and found.unassigned_splats == 0
    total_weight = scene.total_weight * (confidence.numpy() if weight_by == "confidence" else 1)
    for number, thing in enumerate(found.objects):
        rows = np.flatnonzero(found.numbers == number)
        cluster = rows[0] // SPLATS_A_CLUSTER
        assert rows.tolist() == list(range(cluster * SPLATS_A_CLUSTER, (cluster + 1) * SPLATS_A_CLUSTER))
        assert thing.splats == SPLATS_A_CLUSTER
        assert thing.share == pytest.approx(total_weight[rows].sum() / total_weight[answer.selected].sum())
        assert thing.score == pytest.approx(np.average(answer.scores[rows], weights=total_weight[rows]))
        low, high = means(scene, cluster).min(axis=0), means(scene, cluster).max(axis=0)
        # So few splats have a thousandth of the total weight each, or more: the box holds all of them, or nearly.
        assert (np.array(thing.box[0]) >= low).all() and (np.array(thing.box[1]) <= high).all()
        assert np.array(thing.box) == pytest.approx(np.stack([low, high]), abs=0.3)
        assert thing.centre == pytest.approx(np.mean(thing.box, axis=0))
    assert found.objects[0].share >= found.objects[1].share
    assert (found.numbers[SPLATS_A_CLUSTER : 2 * SPLATS_A_CLUSTER] == -1).all()
    nothing = objects(scene, of(scene))
    assert (nothing.objects, nothing.unassigned_splats) == ((), 0) and (nothing.numbers == -1).all()


def test_single_splats_elsewhere_are_strays_and_stretch_no_box(scene: Scene) -> None:
    alone, with_stray = objects(scene, of(scene, 0)), objects(scene, of(scene, 0, rows=(2 * SPLATS_A_CLUSTER,)))
    assert len(with_stray.objects) == 1 and with_stray.unassigned_splats == 1
    assert with_stray.numbers[2 * SPLATS_A_CLUSTER] == -1
    assert with_stray.objects[0].box == alone.objects[0].box
    assert with_stray.objects[0].share < alone.objects[0].share == 1.0
    cluster = np.arange(SPLATS_A_CLUSTER)  # likewise of a thing that is given
    box = module.object_box(scene.splats, cluster, np.ones(len(cluster)))
    strayed = np.append(cluster, 2 * SPLATS_A_CLUSTER)
    assert module.object_box(scene.splats, strayed, np.ones(len(strayed))) == box
    assert module.trimmed_box(scene.splats.means.numpy()[strayed], np.ones(len(strayed))) != box
    joined = np.concatenate([cluster, 2 * SPLATS_A_CLUSTER + cluster])  # of two things that were joined it holds both
    assert module.object_box(scene.splats, joined, np.ones(len(joined))) == module.trimmed_box(
        scene.splats.means.numpy()[joined], np.ones(len(joined))
    )


def test_small_fragment_of_another_thing_is_no_object_beside_a_whole_one(scene: Scene) -> None:
    count, answer = 2 * SPLATS_A_CLUSTER, of(scene, 0)
    near = np.linalg.norm(means(scene, 2) - means(scene, 2)[0], axis=1).argsort()
    fragment = count + near[:4]  # of the last cluster
    selected = answer.selected | np.isin(np.arange(len(answer.selected)), fragment)
    things = np.repeat(np.array([0, -1, 1], np.int32), SPLATS_A_CLUSTER)
    cases = {"of the last": things, "a thing itself": np.where(np.isin(np.arange(len(things)), fragment), 2, things)}
    cases["a thing with a leak beside it"] = np.where(np.isin(np.arange(len(things)), fragment[:2]), 2, things)
    cases["of none"] = np.full(len(things), -1, np.int32)
    found = {}
    for name, own in cases.items():
        lift = replace(
            scene.lift,
            object=torch.from_numpy(own.astype(np.int32)),
            object_views=torch.zeros((3, 3), dtype=torch.int32),
        )
        found[name] = objects(Scene(lift, scene.splats), answer_with(answer, selected=selected))
    assert {name: len(one.objects) for name, one in found.items()} == {
        "of the last": 1,
        "a thing itself": 2,
        "a thing with a leak beside it": 2,
        "of none": 2,
    }
    assert found["of the last"].unassigned_splats == len(fragment)
    large = answer.selected | np.isin(np.arange(len(things)), count + near[:12])
    lift = replace(scene.lift, object=torch.from_numpy(things), object_views=torch.zeros((2, 3), dtype=torch.int32))
    assert len(objects(Scene(lift, scene.splats), answer_with(answer, selected=large)).objects) == 2


def test_who_keeps_the_largest_gets_it_alone_also_as_a_file(scene: Scene) -> None:
    both, largest = objects(scene, of(scene, 0, 2)), objects(scene, of(scene, 0, 2, keep="largest"))
    assert largest.objects == both.objects[:1]
    assert largest.unassigned_splats == both.objects[1].splats
    kept = b"".join(object_splats(scene, of(scene, 0, 2, keep="largest")))
    assert kept == ply(splat_rows()[both.numbers == 0])
    with_stray = of(scene, 0, 2, rows=(3 * SPLATS_A_CLUSTER // 2,))
    assert b"".join(object_splats(scene, with_stray)) == ply(splat_rows()[both.numbers >= 0])


def test_so_many_instances_are_kept_by_their_scores(scene: Scene) -> None:
    all_three, two = objects(scene, of(scene, 0, 1, 2)), objects(scene, of(scene, 0, 1, 2, instances=2))
    assert len(all_three.objects) == 3 and two.unassigned_splats == SPLATS_A_CLUSTER
    assert (two.numbers[:SPLATS_A_CLUSTER] == -1).all()  # the later clusters have the higher scores
    assert two.objects == tuple(
        thing for thing in all_three.objects if thing.score > min(t.score for t in all_three.objects)
    )
    assert objects(scene, of(scene, 0, 2, instances=9)).objects == objects(scene, of(scene, 0, 2)).objects
    for count in (0, 101):
        with pytest.raises(InvalidQuery, match="instances: expected 1 to 100"):
            of(scene, 0, instances=count)


def test_objects_of_fewer_splats_are_outliers(scene: Scene) -> None:
    stray = 5 * SPLATS_A_CLUSTER // 2
    selected = np.arange(3 * SPLATS_A_CLUSTER) < 2 * SPLATS_A_CLUSTER
    selected[:5] = False  # of the first cluster fewer splats are left
    selected[stray] = True
    answer = of(scene, 0)
    for size, count in ((1, 2), (SPLATS_A_CLUSTER - 5, 2), (SPLATS_A_CLUSTER - 4, 1), (SPLATS_A_CLUSTER + 1, 0)):
        found = objects(scene, answer_with(answer, selected=selected, min_size=size))
        assert (len(found.objects), found.numbers[stray]) == (count, -1)
        assert found.unassigned_splats == selected.sum() - sum(thing.splats for thing in found.objects)
    none = answer_with(answer, selected=selected, min_size=SPLATS_A_CLUSTER + 1, keep="largest")
    assert objects(scene, none).objects == ()


def test_tails_of_a_thousandth_are_not_in_the_box() -> None:
    means = np.zeros((2001, 3))
    means[:, 0] = np.arange(2001)
    low, high = module.trimmed_box(means, np.ones(2001))
    assert (low[0], high[0]) == (2, 1998)  # two of 2001 below, two above
    weights = np.ones(2001)
    weights[-1] = 100.0
    assert module.trimmed_box(means, weights)[1][0] == 2000
    assert module.trimmed_box(means[:1], np.ones(1))[0] == (0, 0, 0)


def test_more_splats_than_are_grouped_are_refused(scene: Scene, monkeypatch) -> None:
    monkeypatch.setattr(module, "MOST_SPLATS", SPLATS_A_CLUSTER)
    assert objects(scene, of(scene, 0)).objects
    with pytest.raises(InvalidQuery, match=r"threshold: expected at most 20 splats.*got 21; name a higher"):
        objects(scene, of(scene, 0, rows=(2 * SPLATS_A_CLUSTER,)))


def test_a_twentieth_of_the_evidence_of_the_largest_makes_an_object(scene: Scene) -> None:
    rows = len(scene.features)
    for share, count in ((0.049, 1), (0.051, 2), (1.0, 2)):
        total_weight = torch.ones(rows)
        total_weight[2 * SPLATS_A_CLUSTER :] = share
        weighed = Scene(replace(scene.lift, total_weight=total_weight))
        assert len(objects(weighed, of(scene, 0, 2)).objects) == count
    bare = Scene(replace(scene.lift, total_weight=torch.zeros(rows)))  # without any, splats count alike
    found = objects(bare, of(scene, 0, rows=(2 * SPLATS_A_CLUSTER, 2 * SPLATS_A_CLUSTER + 1)))
    assert found.objects[0].splats == SPLATS_A_CLUSTER
    assert sum(thing.share for thing in found.objects) <= 1.0
