"""What an answer found, thing by thing."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from liftcore.errors import InvalidQuery
from liftcore.query import objects as module
from liftcore.query.ask import Answer, ask
from liftcore.query.export import object_splats
from liftcore.query.objects import NEIGHBOURS, REACH, objects, touching
from liftcore.query.scene import QueryScene
from liftcore.query.terms import Query, Region
from liftcore.scene.splats import Kernel, Splats
from tests.api.tiny_scene import SPLATS_A_CLUSTER, ply, splat_rows
from tests.scenes import random_splats


def of(
    scene: QueryScene, *clusters: int, keep: str = "all", instances: int | None = None, rows: tuple[int, ...] = ()
) -> Answer:
    """An answer that selected these clusters and rows, with scores of .5 and more the later they stand."""
    answer = ask(scene, Query((Region("left", 0, 2),), threshold=0.5, keep=keep, instances=instances))
    selected = np.zeros(3 * SPLATS_A_CLUSTER, np.bool_)
    for cluster in clusters:
        selected[cluster * SPLATS_A_CLUSTER : (cluster + 1) * SPLATS_A_CLUSTER] = True
    selected[list(rows)] = True
    return replace(answer, selected=selected, scores=np.linspace(0.5, 1.0, len(selected), dtype=np.float32))


def means(scene: QueryScene, cluster: int) -> np.ndarray:
    return scene.splats.means.numpy()[cluster * SPLATS_A_CLUSTER : (cluster + 1) * SPLATS_A_CLUSTER]


def test_clusters_that_are_apart_are_objects_with_their_boxes(scene: QueryScene) -> None:
    answer = of(scene, 0, 2)
    found = objects(scene, answer)
    assert len(found.found) == 2 and found.strays == 0
    evidence = scene.evidence
    for number, thing in enumerate(found.found):
        rows = np.flatnonzero(found.numbers == number)
        cluster = rows[0] // SPLATS_A_CLUSTER
        assert rows.tolist() == list(range(cluster * SPLATS_A_CLUSTER, (cluster + 1) * SPLATS_A_CLUSTER))
        assert thing.splats == SPLATS_A_CLUSTER
        assert thing.share == pytest.approx(evidence[rows].sum() / evidence[answer.selected].sum())
        assert thing.score == pytest.approx(np.average(answer.scores[rows], weights=evidence[rows]))
        low, high = means(scene, cluster).min(axis=0), means(scene, cluster).max(axis=0)
        # So few splats have a thousandth of the evidence each, or more: the box holds all of them, or nearly.
        assert (np.array(thing.box[0]) >= low).all() and (np.array(thing.box[1]) <= high).all()
        assert np.array(thing.box) == pytest.approx(np.stack([low, high]), abs=0.3)
        assert thing.centre == pytest.approx(np.mean(thing.box, axis=0))
    assert found.found[0].share >= found.found[1].share
    assert (found.numbers[SPLATS_A_CLUSTER : 2 * SPLATS_A_CLUSTER] == -1).all()


def test_single_splats_elsewhere_are_strays_and_stretch_no_box(scene: QueryScene) -> None:
    alone, with_stray = objects(scene, of(scene, 0)), objects(scene, of(scene, 0, rows=(2 * SPLATS_A_CLUSTER,)))
    assert len(with_stray.found) == 1 and with_stray.strays == 1
    assert with_stray.numbers[2 * SPLATS_A_CLUSTER] == -1
    assert with_stray.found[0].box == alone.found[0].box
    assert with_stray.found[0].share < alone.found[0].share == 1.0
    cluster = np.arange(SPLATS_A_CLUSTER)  # likewise of a thing that is given
    box = module.largest_box(scene.splats, cluster, np.ones(len(cluster)))
    strayed = np.append(cluster, 2 * SPLATS_A_CLUSTER)
    assert module.largest_box(scene.splats, strayed, np.ones(len(strayed))) == box
    assert module.trimmed_box(scene.splats.means.numpy()[strayed], np.ones(len(strayed))) != box


def test_who_keeps_the_largest_gets_it_alone_also_as_a_file(scene: QueryScene) -> None:
    both, largest = objects(scene, of(scene, 0, 2)), objects(scene, of(scene, 0, 2, keep="largest"))
    assert largest.found == both.found[:1]
    assert largest.strays == both.found[1].splats
    kept = b"".join(object_splats(scene, of(scene, 0, 2, keep="largest")))
    assert kept == ply(splat_rows()[both.numbers == 0])
    with_stray = of(scene, 0, 2, rows=(3 * SPLATS_A_CLUSTER // 2,))
    assert b"".join(object_splats(scene, with_stray)) == ply(splat_rows()[both.numbers >= 0])


def test_so_many_instances_are_kept_by_their_scores(scene: QueryScene) -> None:
    all_three, two = objects(scene, of(scene, 0, 1, 2)), objects(scene, of(scene, 0, 1, 2, instances=2))
    assert len(all_three.found) == 3 and two.strays == SPLATS_A_CLUSTER
    assert (two.numbers[:SPLATS_A_CLUSTER] == -1).all()  # the later clusters have the higher scores
    assert two.found == tuple(
        thing for thing in all_three.found if thing.score > min(t.score for t in all_three.found)
    )
    assert objects(scene, of(scene, 0, 2, instances=9)).found == objects(scene, of(scene, 0, 2)).found
    for count in (0, 101):
        with pytest.raises(InvalidQuery, match="instances: expected 1 to 100"):
            of(scene, 0, instances=count)


def test_nothing_found_is_no_object(scene: QueryScene) -> None:
    found = objects(scene, of(scene))
    assert (found.found, found.strays) == ((), 0)
    assert (found.numbers == -1).all()


def test_without_evidence_splats_count_alike(scene: QueryScene) -> None:
    bare = QueryScene(replace(scene.lift, evidence=torch.zeros_like(scene.lift.evidence)))
    found = objects(bare, of(scene, 0, rows=(2 * SPLATS_A_CLUSTER, 2 * SPLATS_A_CLUSTER + 1)))
    assert found.found[0].splats == SPLATS_A_CLUSTER
    assert sum(thing.share for thing in found.found) <= 1.0


def test_tails_of_a_thousandth_are_not_in_the_box() -> None:
    means = np.zeros((2001, 3))
    means[:, 0] = np.arange(2001)
    low, high = module.trimmed_box(means, np.ones(2001))
    assert (low[0], high[0]) == (2, 1998)  # two of 2001 below, two above
    weights = np.ones(2001)
    weights[-1] = 100.0
    assert module.trimmed_box(means, weights)[1][0] == 2000
    assert module.trimmed_box(means[:1], np.ones(1))[0] == (0, 0, 0)


def test_more_splats_than_are_grouped_are_refused(scene: QueryScene, monkeypatch) -> None:
    monkeypatch.setattr(module, "MOST_SPLATS", SPLATS_A_CLUSTER)
    assert objects(scene, of(scene, 0)).found
    with pytest.raises(InvalidQuery, match=r"threshold: expected at most 20 splats.*got 21; name a higher"):
        objects(scene, of(scene, 0, rows=(2 * SPLATS_A_CLUSTER,)))


def test_a_twentieth_of_the_evidence_of_the_largest_makes_an_object(scene: QueryScene) -> None:
    for share, count in ((0.049, 1), (0.051, 2)):
        evidence = torch.full_like(scene.lift.evidence, 1.0)
        evidence[2 * SPLATS_A_CLUSTER :] = share
        weighed = QueryScene(replace(scene.lift, evidence=evidence))
        assert len(objects(weighed, of(scene, 0, 2)).found) == count


FEW = NEIGHBOURS + 1  # of so many splats, each looks at all others


def by_pairs(splats: Splats) -> np.ndarray:
    """Groups by the rule itself, for so few splats that all are neighbours."""
    count = splats.count
    means = splats.means.double().numpy()
    axes = [
        Rotation.from_quat(splats.quats[j].double().numpy(), scalar_first=True).as_matrix()[
            :, : splats.log_scales.shape[1]
        ]
        * splats.log_scales[j].double().exp().numpy()
        for j in range(count)
    ]
    groups = np.arange(count)
    for j in range(count):
        for k in range(j):
            apart = means[j] - means[k]
            distance = np.linalg.norm(apart)
            line = apart / distance if distance else np.zeros(3)
            if distance <= REACH * sum(np.linalg.norm(axes[i].T @ line) for i in (j, k)):
                groups[groups == groups[j]] = groups[k]
    return groups


def same_partition(one: np.ndarray, other: np.ndarray) -> bool:
    return bool(((one[:, None] == one) == (other[:, None] == other)).all())


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6), count=st.integers(1, FEW), spread=st.floats(0.2, 5.0),
    kernel=st.sampled_from(list(Kernel)),
)  # fmt: skip
def test_groups_are_those_of_the_rule(seed: int, count: int, spread: float, kernel: Kernel) -> None:
    splats = random_splats(seed, count, spread, kernel)
    assert same_partition(touching(splats, np.arange(count)), by_pairs(splats))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), power=st.integers(-10, 10))
def test_groups_know_no_unit_and_no_order(seed: int, power: int) -> None:
    splats, factor = random_splats(seed, 150, 3.0), 2.0**power
    scaled = replace(splats, means=factor * splats.means, log_scales=splats.log_scales + float(np.log(factor)))
    order = np.random.default_rng(seed).permutation(150)
    groups = touching(splats, np.arange(150))
    assert same_partition(touching(splats, order), groups[order])
    assert same_partition(touching(scaled, np.arange(150)), groups)


def needle(x: float, y: float) -> Splats:
    """One as long as 1 along x, two points at x and y on the axes."""
    means = torch.tensor([[0.0, 0.0, 0.0], [x, 0.0, 0.0], [0.0, y, 0.0]])
    log_scales = torch.log(torch.tensor([[1.0, 1e-3, 1e-3], [1e-3] * 3, [1e-3] * 3]))
    return Splats(means, torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 3), log_scales, torch.zeros(3))


def test_a_needle_touches_what_lies_along_it_and_nothing_beside() -> None:
    assert touching(needle(1.9, 0.1), np.arange(3)).tolist() == [0, 0, 1]
    assert touching(needle(2.1, 0.1), np.arange(3)).tolist() == [0, 1, 2]
    turned = replace(needle(0.1, 1.9), quats=torch.tensor([[1.0, 0.0, 0.0, 1.0]] * 3))  # now along y
    assert touching(turned, np.arange(3)).tolist() == [0, 1, 0]


def test_others_do_not_connect() -> None:
    row = needle(1.9, 0.1)
    assert touching(row, np.array([1, 2])).tolist() == [0, 1]  # the needle between them was not asked for
    assert touching(row, np.array([1])).tolist() == [0]
    assert touching(row, np.array([], np.int64)).tolist() == []


def test_equal_places_and_extreme_sizes_are_no_trouble() -> None:
    means = torch.tensor([[0.0, 0.0, 0.0]] * 30 + [[5.0, 0.0, 0.0], [1e4, 0.0, 0.0]])
    log_scales = torch.full((32, 3), -torch.inf)
    log_scales[31] = 500.0
    splats = Splats(means, torch.zeros(32, 4), log_scales, torch.zeros(32))
    groups = touching(splats, np.arange(32))
    assert len(set(groups[:30])) == 1 and groups[30] == groups[31]  # one as large as this reaches its neighbours


def test_a_quaternion_of_zero_turns_nothing() -> None:
    still = replace(needle(1.9, 0.1), quats=torch.zeros(3, 4))
    assert touching(still, np.arange(3)).tolist() == [0, 0, 1]
    assert touching(replace(still, means=still.means.roll(1, dims=1)), np.arange(3)).tolist() == [0, 1, 2]
