"""What the plan says of channels and memory."""

from __future__ import annotations

import errno
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from liftcore.device import CPU
from liftcore.errors import InvalidSettings, Unavailable
from liftcore.features.pack import read_features, write_pack
from liftcore.features.views import Regions
from liftcore.io.lift_file import load_lift, save_lift
from liftcore.lift import lift, open_sources, planned
from liftcore.plan.memory import (
    CONTROL_GROUPS,
    LIBRARIES,
    all_columns,
    check_memory,
    free_memory,
    group_memory,
)
from liftcore.plan.rank import ROUNDING, Rank, codebook_rank, rank_of
from liftcore.settings import LiftSettings, Speed
from liftcore.solve.columns import as_walked
from liftcore.solve.feature_room import file_system, in_file, room_within
from tests.scenes import observed
from tests.unit.solve.test_lift_equals_dense import write_scene

GIB = 1 << 30


@pytest.mark.parametrize("dtype", ["float16", "float32"])
@pytest.mark.parametrize("rank", [1, 7, 40])
@pytest.mark.parametrize("shape", [(300, 64), (50, 96)])
def test_rank_is_that_of_the_vectors_before_they_were_rounded(dtype, rank, shape):
    rng = np.random.default_rng(rank)
    rows = rng.normal(size=(shape[0], rank)) @ rng.normal(size=(rank, shape[1]))
    found = rank_of(rows.astype(dtype).astype(np.float64), ROUNDING["F16" if dtype == "float16" else "F32"])
    assert (found.rank, found.rows, found.channels) == (rank, *shape)
    assert 1 <= found.enough <= rank


def test_nothing_has_no_rank():
    assert rank_of(np.zeros((4, 3)), ROUNDING["F32"]).rank == 0


def test_rank_of_packs_of_two_types_is_above_the_coarser_rounding(tmp_path):
    rows = torch.rand(100, 3, generator=torch.manual_seed(0)) @ torch.rand(3, 40, generator=torch.manual_seed(1))
    labels = torch.zeros(1, 2, 2, dtype=torch.int32)
    write_pack(tmp_path / "p", {"v0": Regions(labels, rows), "v1": Regions(labels, rows.half())}, {})
    packs = read_features(tmp_path / "p")
    assert codebook_rank(packs, packs.views).rank == 3


@pytest.mark.parametrize(("rank", "bound"), [((8, 6, 5, 3), ""), ((4, 6, 4, 3), "at least "), ((6, 6, 6, 3), "")])
def test_rank_as_large_as_its_sample_is_told_as_a_bound(tmp_path, rank, bound):
    paths = write_scene(tmp_path, 2)
    plan = planned(open_sources(paths[0], paths[1], [paths[2]], LiftSettings.of()), LiftSettings.of(), CPU, 1)
    rows, channels, number, enough = rank
    told = "\n".join(replace(plan, rank=Rank(channels, rows, number, enough)).lines())
    assert (
        f"{channels} channels; {rows} sampled codebook rows have rank {bound}{number}, and {enough} directions"
        in told
    )
    assert plan.kept_on_card == 0  # there is none


@pytest.mark.parametrize("grids", [False, True])
def test_rank_of_packs_looks_at_all_their_views(tmp_path, grids):
    packs = read_features(write_scene(tmp_path, 2, grids)[2])
    found = codebook_rank(packs, packs.views)
    assert (found.channels, found.rank) == (6, 6)
    assert found.rows >= 6


def test_tuples_of_labels_are_planned_with_no_fewer_columns_than_there_are(tmp_path):
    maps = {f"v{k}": observed(2, k) for k in (1, 3)}
    write_pack(tmp_path / "p", maps, {})
    packs, tuples, rows = read_features(tmp_path / "p"), LiftSettings.of(), LiftSettings.of(robust_steps=1)
    made = [as_walked(own, tuples)[1] for own in maps.values()]
    assert all(columns.tuples is not None for columns in made)
    assert all_columns(packs, maps, rows) == sum(own.codebook.shape[0] for own in maps.values())
    assert all_columns(packs, maps, tuples) >= sum(columns.count for columns in made)


def test_tuples_of_labels_are_planned_with_fewer_entries_than_rows(tmp_path):
    paths = write_scene(tmp_path, 2)  # one of its views has tuples

    def entries(**own) -> float:
        settings = LiftSettings.of(**own)
        return planned(open_sources(paths[0], paths[1], [paths[2]], settings), settings, CPU).entries_a_splat

    assert 1.0 < entries() < entries(robust_steps=1)


def test_a_robust_step_holds_as_much_again_of_each_gathered_entry(tmp_path):
    paths = write_scene(tmp_path, 2)

    def gathered(**own) -> int:
        settings = LiftSettings.of(aggregation=True, aggregation_resolve=True, **own)  # columns are rows for both
        return planned(open_sources(paths[0], paths[1], [paths[2]], settings), settings, CPU).memory["gathered"]

    assert gathered(robust_steps=1) == 2 * gathered() > 0


@pytest.mark.parametrize(("limit", "dense", "told"), [(0, 1, True), (0, 100, False), (GIB, 1, False)])
def test_what_dense_maps_cost_is_told_where_there_is_much_to_save(tmp_path, monkeypatch, limit, dense, told):
    splats, cameras, pack = write_scene(tmp_path, 2, grids=True)
    monkeypatch.setattr("liftcore.plan.memory.MEMORY_LIMIT", limit)
    monkeypatch.setattr("liftcore.plan.memory.DENSE_ENTRIES", dense)
    warnings = lift(splats, cameras, [pack], LiftSettings.of(certificate_rays=10)).metadata.certificate["warnings"]
    about = [warning for warning in warnings if warning.startswith("the maps are dense: ")]
    assert bool(about) is told
    assert all("regions, or coarser grids, of the same features lift faster" in warning for warning in about)


@pytest.mark.parametrize(
    ("own", "part"),
    [
        ({"cg_steps": 1}, "refinement"),
        ({"reference_channels": 4}, "refinement"),
        ({"aggregation": True}, "aggregation"),
    ],
)
def test_what_comes_after_the_walks_is_planned_where_it_comes(tmp_path, own, part):
    sources = open_sources(*write_scene(tmp_path, 2)[:2], [tmp_path / "features.safetensors"], LiftSettings.of())
    plain, more = (planned(sources, LiftSettings.of(**chosen), CPU).memory for chosen in ({}, own))
    assert set(more) - set(plain) == {part}
    assert more[part] > 0


def test_region_weights_that_go_to_files_are_planned_and_their_disk_is_looked_at(tmp_path, monkeypatch, disk):
    paths = write_scene(tmp_path, 2)

    def plan_of(**own):
        settings = LiftSettings.of(**own)
        return planned(open_sources(paths[0], paths[1], [paths[2]], settings), settings, CPU)

    assert (plan_of().in_files, plan_of().facts()["weights_in_files_bytes"]) == (0, 0)
    monkeypatch.setattr("liftcore.plan.memory.MEMORY_LIMIT", 0)
    assert 0 < plan_of().in_files < plan_of(robust_steps=1).in_files
    assert "of region weights go to files" in "\n".join(plan_of().lines())
    assert plan_of().warnings == ()
    disk(0)
    assert "0.0 GiB of disk: set TMPDIR" in "\n".join(plan_of().lines())
    monkeypatch.setattr("liftcore.solve.feature_room.file_system", lambda _: "tmpfs")
    (told,) = plan_of().warnings
    assert "a temporary folder that lies in memory itself: set TMPDIR" in told


@pytest.fixture
def disk(monkeypatch):
    def has(free):
        monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=free))

    has(100 * GIB)
    return has


def test_what_cannot_fit_is_refused_and_what_may_not_is_told(disk):
    parts = {"features": 6 * GIB, "codebooks": GIB, "weights": GIB}
    assert check_memory(parts, 20 * GIB) == []
    assert check_memory(parts, None) == []
    (told,) = check_memory(parts, 8 * GIB)
    assert "6.0 GiB, do not fit into the 8.0 GiB that are free" in told
    assert "the rest of the lift may take 2.0 GiB" in check_memory(parts, 2 * GIB)[1]
    with pytest.raises(Unavailable, match=r"1\.0 GiB for codebooks"):
        check_memory(parts, GIB - 1)


def test_features_that_fit_neither_memory_nor_disk_are_refused_before_the_work(disk):
    parts = {"features": 6 * GIB, "codebooks": GIB}
    disk(5 * GIB)
    assert check_memory(parts, 20 * GIB) == []
    with pytest.raises(Unavailable, match=r"6\.0 GiB of memory for them, or of disk.*got 5\.0 GiB of disk"):
        check_memory(parts, 7 * GIB)


def test_a_temporary_folder_in_memory_is_no_disk(monkeypatch, tmp_path):
    mounts = tmp_path / "mounts"
    mounts.write_text(f"disk / ext4 rw 0 0\nnone {tmp_path} tmpfs rw 0 0\n")
    assert file_system(tmp_path / "below", mounts) == "tmpfs"
    assert file_system(tmp_path.parent, mounts) == "ext4"
    assert file_system(tmp_path, tmp_path / "absent") == ""
    monkeypatch.setattr("liftcore.solve.feature_room.file_system", lambda _: "tmpfs")
    with pytest.raises(Unavailable, match="lies in memory itself"):
        in_file(10, 7, torch.float16)


def test_features_that_come_out_wider_than_planned_find_their_room_by_what_they_are():
    limit = 1000 * 7 * 2
    places = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("liftcore.solve.feature_room.in_file", lambda *shape: places.append(shape))
        for dtype in (torch.float16, torch.float32):
            room_within(limit)(1000, 7, dtype)
    assert places == [(1000, 7, torch.float32)]


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_features_in_a_file_are_zeros_that_keep_what_is_written(dtype):
    room = in_file(1000, 7, dtype)
    assert (room.shape, room.dtype, room.any()) == ((1000, 7), dtype, False)
    room[3] = 2
    assert room.sum() == 14


def test_a_disk_that_is_full_by_then_is_told_and_ends_nothing(monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.posix_fallocate", full)
    with pytest.raises(Unavailable, match="No space left on device"):
        in_file(1000, 7, torch.float16)


def test_a_lift_whose_features_do_not_fit_is_the_same_through_a_file(tmp_path, monkeypatch, disk):
    scene = write_scene(tmp_path, 2)
    rooms = []
    monkeypatch.setattr(
        "liftcore.solve.feature_room.in_file", lambda *shape: rooms.append(in_file(*shape)) or rooms[-1]
    )
    inside = lift(scene[0], scene[1], [scene[2]], LiftSettings.of())
    assert not rooms
    monkeypatch.setattr("liftcore.plan.plan.free_memory", lambda: LIBRARIES)
    through = lift(scene[0], scene[1], [scene[2]], LiftSettings.of())
    assert len(rooms) == 1
    assert torch.equal(through.features, inside.features)
    save_lift(through, tmp_path / "through.safetensors")
    assert torch.equal(load_lift(tmp_path / "through.safetensors").features, inside.features)


STAT = f"anon {GIB}\nfile {5 * GIB}\ninactive_file {3 * GIB}\nactive_file {GIB}\n"


@pytest.mark.parametrize(
    ("limit", "used", "stat", "free"),
    [
        (f"{8 * GIB}\n", f"{6 * GIB}\n", STAT, 6 * GIB),  # four of the six are files that were read
        (f"{8 * GIB}\n", f"{6 * GIB}\n", "anon 0\n", 2 * GIB),
        (f"{GIB}\n", f"{2 * GIB}\n", "", 0),
        (f"{8 * GIB}\n", f"{GIB}\n", STAT, 8 * GIB),  # the two are not read at one moment
        (f"{8 * GIB}\n", f"{6 * GIB}\n", STAT + f"total_inactive_file {4 * GIB}\n", 7 * GIB),
        ("max\n", f"{6 * GIB}\n", STAT, None),
    ],
)
def test_files_that_were_read_take_no_room_of_a_control_group(limit, used, stat, free):
    assert group_memory(limit, used, stat) == free


@pytest.mark.parametrize("version", [0, 1])
def test_the_limit_of_either_version_of_control_groups_counts(tmp_path, monkeypatch, version):
    group = CONTROL_GROUPS[version][1]
    for name, text in zip(group, (str(GIB >> 10), "0", STAT), strict=True):
        (tmp_path / name).write_text(text)
    monkeypatch.setattr("liftcore.plan.memory.CONTROL_GROUPS", [(str(tmp_path), group), ("/nowhere", group)])
    assert free_memory() == GIB >> 10


def test_what_this_machine_has_free_is_told_and_leaves_no_trace_in_the_lift(tmp_path, monkeypatch, caplog):
    splats, cameras, pack = write_scene(tmp_path, 2)
    certificates = []
    for free in (None, LIBRARIES):
        monkeypatch.setattr("liftcore.plan.plan.free_memory", lambda free=free: free)
        certificates.append(lift(splats, cameras, [pack], LiftSettings.of()).metadata.certificate)
        assert ("GiB are free" in caplog.text) is (free is not None)
    assert certificates[0] == certificates[1]


def test_the_dial_sets_what_is_not_set_beside_it():
    fast, drafted = LiftSettings.of(speed="fast"), LiftSettings.of(speed="draft", stride=2, preset="row-sum")
    assert LiftSettings.of(speed="exact").model_dump() == LiftSettings.of().model_dump()
    assert (fast.stride > 1, fast.certificate_rays < 10_000, fast.power) == (True, True, 2)
    assert (drafted.stride, drafted.power, drafted.transmittance_stop > 1e-4) == (2, 1, True)
    strides = [LiftSettings.of(speed=speed).stride for speed in Speed]
    assert strides == sorted(strides)
    with pytest.raises(InvalidSettings, match="speed"):
        LiftSettings.of(speed="ludicrous")


def test_the_certificate_is_the_same_whatever_the_number_of_threads(tmp_path):
    splats, cameras, pack = write_scene(tmp_path, 2)
    settings = LiftSettings.of(device="cpu")
    told = [lift(splats, cameras, [pack], settings, threads=n).metadata.certificate for n in (1, 3)]
    assert told[0] == told[1]


def test_a_plan_finds_room_for_the_views_that_its_threads_have_in_work(tmp_path, monkeypatch):
    splats, cameras, pack = write_scene(tmp_path, 2)
    settings = LiftSettings.of(device="cpu")
    sources = open_sources(splats, cameras, [pack], settings)
    monkeypatch.setattr("liftcore.plan.plan.free_memory", lambda: GIB)
    one, two, many = (planned(sources, settings, CPU, threads) for threads in (1, 2, 64))
    assert (one.at_once, two.at_once, many.at_once) == (1, 2, len(sources.views))
    assert one.facts() == many.facts()
    assert None not in (one.features_room, two.features_room)
    assert (one.features_room or 0) - (two.features_room or 0) == one.memory["view"]
