"""Torch and linear algebra use the calling thread alone within `one_thread`."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from threading import Barrier, Event

import pytest
import torch
from threadpoolctl import ThreadpoolController, threadpool_limits

from liftcore.runtime.one_thread import one_thread


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


@pytest.mark.parametrize("first_fails", [False, True])
def test_two_threads_within_it_at_once_leave_nothing_behind(first_fails: bool):
    barrier, first_left, second_counted = Barrier(2), Event(), Event()

    def number_of_a_new_thread() -> int:
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(torch.get_num_threads).result()

    def set_three() -> None:
        torch.get_num_threads()  # a thread's first call takes the process's count, which the other may have set
        torch.set_num_threads(3)

    def first() -> int:
        set_three()
        with suppress(ValueError), one_thread():
            barrier.wait(10)
            if first_fails:
                raise ValueError("no")
        first_left.set()
        assert second_counted.wait(10)
        return torch.get_num_threads()

    def second() -> tuple[int, int, int]:
        set_three()
        with one_thread():
            barrier.wait(10)
            assert first_left.wait(10) and all_are(1)
            within = torch.get_num_threads(), number_of_a_new_thread()
            second_counted.set()
        return *within, torch.get_num_threads()

    with ThreadPoolExecutor(2) as pool:
        futures = pool.submit(first), pool.submit(second)
        assert futures[1].result() == (1, 1, 3)
        assert futures[0].result() == 3
    assert number_of_a_new_thread() == 3 and all_are(3)
