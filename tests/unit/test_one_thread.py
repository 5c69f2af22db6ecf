"""Torch and linear algebra keep to the thread that calls them, as long as they are told to."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from threading import Barrier, Event

import pytest
import torch
from threadpoolctl import ThreadpoolController, threadpool_limits

from liftcore.lifting import geometry
from liftcore.lifting.files import lift_files
from liftcore.runtime.one_thread import one_thread
from liftcore.solve import closed_form, reweight
from liftcore.values.settings import LiftSettings
from tests.scenes import write_scene


@pytest.fixture(autouse=True)
def three_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    with threadpool_limits(3, user_api="blas"):
        yield
    torch.set_num_threads(before)


def threads_of_linear_algebra() -> list[int]:
    libraries = ThreadpoolController().select(user_api="blas").lib_controllers
    assert libraries
    return [library.num_threads for library in libraries]


def all_are(number: int) -> bool:
    return set(threads_of_linear_algebra()) == {number}


def test_it_is_one_thread_within_and_as_many_as_before_after_it():
    with one_thread():
        assert torch.get_num_threads() == 1 and all_are(1)
        with one_thread():
            assert torch.get_num_threads() == 1 and all_are(1)
        assert torch.get_num_threads() == 1 and all_are(1)
        with ThreadPoolExecutor(1) as pool:
            assert pool.submit(torch.get_num_threads).result() == 1
    assert torch.get_num_threads() == 3 and all_are(3)
    with pytest.raises(ValueError, match="no"), one_thread():
        raise ValueError("no")
    assert torch.get_num_threads() == 3 and all_are(3)


def test_a_lift_has_no_threads_of_torch(tmp_path, monkeypatch):
    seen = {}

    def watch(module, name: str) -> None:
        work = getattr(module, name)

        def watched(*given):
            seen[name] = torch.get_num_threads()
            return work(*given)

        monkeypatch.setattr(module, name, watched)

    watch(geometry, "as_regions")
    watch(geometry, "stacked")
    watch(reweight, "row_blocks")
    watch(closed_form, "sum_rows")
    splats, cameras, features = write_scene(tmp_path, 3)[:3]
    lift_files(splats, cameras, [features], LiftSettings.of(robust_steps=1))
    assert seen == dict.fromkeys(("as_regions", "stacked", "row_blocks", "sum_rows"), 1)
    assert torch.get_num_threads() == 3


@pytest.mark.parametrize("first_fails", [False, True])
def test_two_threads_within_it_at_once_leave_nothing_behind(first_fails: bool):
    both, first_left, looked = Barrier(2), Event(), Event()

    def number_of_a_new_thread() -> int:
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(torch.get_num_threads).result()

    def first() -> int:
        torch.set_num_threads(3)
        with suppress(ValueError), one_thread():
            both.wait(10)
            if first_fails:
                raise ValueError("no")
        first_left.set()
        assert looked.wait(10)
        return torch.get_num_threads()

    def second() -> tuple[int, int, int]:
        torch.set_num_threads(3)
        with one_thread():
            both.wait(10)
            assert first_left.wait(10) and all_are(1)
            within = torch.get_num_threads(), number_of_a_new_thread()
            looked.set()
        return *within, torch.get_num_threads()

    with ThreadPoolExecutor(2) as pool:
        ended = pool.submit(first), pool.submit(second)
        assert ended[1].result() == (1, 1, 3)
        assert ended[0].result() == 3
    assert number_of_a_new_thread() == 3 and all_are(3)


def test_libraries_that_are_loaded_within_it_are_held_by_whoever_comes_next():
    code = """
import numpy
from threadpoolctl import ThreadpoolController
from liftcore.runtime.one_thread import one_thread

def numbers():
    libraries = ThreadpoolController().select(user_api="blas").lib_controllers
    return {one.filepath: one.num_threads for one in libraries}

with one_thread():
    before = numbers()
    import scipy.linalg
    usual = numbers()
    with one_thread():
        within = numbers()
assert set(before) < set(within) and set(within.values()) == {1}, within
assert {path: one for path, one in numbers().items() if path not in before} == {
    path: one for path, one in usual.items() if path not in before
}
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
