"""Sums over pieces of a scene: the same bits whichever piece ends first."""

import threading

import numpy as np

from liftcore.solve.sums import PIECE, piece_sums, sum_pieces


def test_pieces_are_added_in_order_whichever_ends_first() -> None:
    values, last_has_ended = (1.0, 1e16, -1e16), threading.Event()  # 0 in order, 1 from the last piece on

    def add(first: int, last: int, table: np.ndarray) -> None:
        if first == 0:
            assert last_has_ended.wait(30)
        table[:] = values[first // PIECE]
        if last == 3 * PIECE:
            last_has_ended.set()

    total = sum_pieces(piece_sums(add, 3 * PIECE, (1, 1), threads=3), (1, 1))
    assert total.item() == (values[0] + values[1]) + values[2] == 0.0
