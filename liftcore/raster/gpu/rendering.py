"""``A X`` on the device: images in blocks of channels, and the strongest label of every ray.

Both are products of a chunk's weights [256, CHUNK] with a row of values a splat: its channels, or its label one-hot.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import triton.language as tl

from liftcore.raster.base import TILE
from liftcore.raster.gpu.launching import WARPS, jit, lang, launch
from liftcore.raster.gpu.walk import CHUNK, PART, PARTS, blend_chunk, fill_alphas, start_rays, weights_of

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.raster.gpu.frame import Frame
    from liftcore.raster.gpu.tile_lists import Lists

WIDEST = 64  # channels a walk
NARROWEST = 16  # columns of a matrix product

_CHUNK = tl.constexpr(CHUNK)
_TILE = tl.constexpr(TILE)
_PIXELS = tl.constexpr(TILE * TILE)
_SCRATCH = tl.constexpr(PARTS * PART)
_NO_LABEL = tl.constexpr(-1)


@jit
def _render(
    places, inks, starts, items, scratch, values, image, band_tile, own_tile, columns, width, height, channels,
    cap, stop, floor, KIND: tl.constexpr, CHANNELS: tl.constexpr,
):  # fmt: skip
    own = own_tile + tl.program_id(0)
    tile = band_tile + own
    top = band_tile // columns * _TILE  # the image is the band's
    mine = scratch + tl.program_id(0) * _SCRATCH
    pixel = tl.arange(0, _PIXELS)
    channel = tl.arange(0, CHANNELS)
    at = tl.load(starts + own)
    last = tl.load(starts + own + 1)
    light = start_rays(tile, columns, width, height)
    sums = tl.zeros([_PIXELS, CHANNELS], tl.float32)
    lit = lang.max(light, 0)
    while (at < last) & (lit > 0.0):
        count = (last - at).to(tl.int32)
        fill_alphas(places, inks, items, at, last, tile, columns, mine, cap, floor, KIND, False)
        light = blend_chunk(mine, light, stop, count)
        number = at + tl.arange(0, _CHUNK)
        item = tl.load(items + number, mask=number < last, other=0).to(tl.int64)
        given = (number < last)[:, None] & (channel < channels)[None, :]
        rows = tl.load(values + item[:, None] * channels + channel[None, :], mask=given, other=0.0)
        sums += tl.dot(tl.trans(weights_of(mine, count, pixel)), rows, input_precision="ieee")
        lit = lang.max(light, 0)
        at += _CHUNK
    x = tile % columns * _TILE + pixel % _TILE
    y = tile // columns * _TILE + pixel // _TILE
    place = ((y - top).to(tl.int64) * width + x)[:, None] * channels + channel[None, :]
    tl.store(image + place, sums, mask=((x < width) & (y < height))[:, None] & (channel < channels)[None, :])


@jit
def _strongest(
    places, inks, starts, items, scratch, slots, label_starts, labels, image, band_tile, own_tile, columns, width,
    height, cap, stop, floor, KIND: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    own = own_tile + tl.program_id(0)
    tile = band_tile + own
    mine = scratch + tl.program_id(0) * _SCRATCH
    pixel = tl.arange(0, _PIXELS)
    column = tl.arange(0, COLUMNS)
    last = tl.load(starts + own + 1)
    first_label = tl.load(label_starts + own)
    known = (tl.load(label_starts + own + 1) - first_label).to(tl.int32)
    best = tl.zeros([_PIXELS], tl.float32)
    winner = tl.full([_PIXELS], _NO_LABEL, tl.int32)
    for block in range(0, known, COLUMNS):
        at = tl.load(starts + own)
        light = start_rays(tile, columns, width, height)
        sums = tl.zeros([_PIXELS, COLUMNS], tl.float32)
        lit = lang.max(light, 0)
        while (at < last) & (lit > 0.0):
            count = (last - at).to(tl.int32)
            fill_alphas(places, inks, items, at, last, tile, columns, mine, cap, floor, KIND, False)
            light = blend_chunk(mine, light, stop, count)
            number = at + tl.arange(0, _CHUNK)
            slot = tl.load(slots + number, mask=number < last, other=-1)
            onehot = (slot[:, None] == (block + column)[None, :]).to(tl.float32)
            sums += tl.dot(tl.trans(weights_of(mine, count, pixel)), onehot, input_precision="ieee")
            lit = lang.max(light, 0)
            at += _CHUNK
        largest, place = lang.max(sums, 1, return_indices=True, return_indices_tie_break_left=True)
        better = largest > best  # labels ascend, so the smallest of equal sums stays
        label = tl.load(labels + first_label + block + place, mask=better, other=_NO_LABEL)
        winner = tl.where(better, label, winner)
        best = tl.where(better, largest, best)
    x = tile % columns * _TILE + pixel % _TILE
    y = tile // columns * _TILE + pixel // _TILE
    tl.store(image + y.to(tl.int64) * width + x, winner, mask=(x < width) & (y < height))


def render(frame: Frame, values: Tensor) -> Tensor:
    """``A X``: values [P, C] f32 on the host, C at most ``WIDEST`` -> [H, W, C] f32 on the host."""
    image = torch.empty(frame.height, frame.width, values.shape[1])
    for band in frame.bands:
        _render_band(frame, frame.lists_of(band), values, image)
    return image


def _render_band(frame: Frame, lists: Lists, values: Tensor, image: Tensor) -> None:
    channels = values.shape[1]
    rows = frame.of_splats(values, lists)
    top = lists.first_row * TILE
    tall = min(lists.tiles // frame.columns * TILE, frame.height - top)
    own = torch.zeros(tall, frame.width, channels, device=frame.device)
    wide = max(NARROWEST, 1 << (channels - 1).bit_length())
    for first, last in frame.tile_runs(lists):
        launch(
            _render, last - first, *lists.splats, lists.starts, lists.items, frame.scratch(last - first),
            rows, own, lists.first_tile, first, *frame.size, channels, *frame.cuts,
            KIND=frame.kind, CHANNELS=wide, warps=8 if wide == WIDEST else WARPS,
        )  # fmt: skip
    image[top : top + tall] = own.cpu()


def strongest_labels(frame: Frame, labels: Tensor) -> Tensor:
    """``argmax(A onehot(labels))``: labels [P] i32 of -1 or more, on the host -> [H, W] i32 on the device."""
    image = torch.full((frame.height, frame.width), -1, dtype=torch.int32, device=frame.device)
    classes = int(labels.max()) + 2
    for band in frame.bands:
        _strongest_in(frame, frame.lists_of(band), (labels, classes), image)
    return image


def _strongest_in(frame: Frame, lists: Lists, given: tuple[Tensor, int], image: Tensor) -> None:
    labels, classes = given
    tiles = torch.arange(lists.tiles, device=frame.device)
    tile_of = torch.repeat_interleave(tiles, lists.starts.diff())
    # The labels that occur in each tile, ascending, and where each item's label stands among them.
    keys = tile_of * classes + frame.of_splats(labels, lists)[lists.items.long()] + 1
    known, slots = torch.unique(keys, return_inverse=True)
    edges = torch.arange(lists.tiles + 1, device=frame.device)
    label_starts = torch.searchsorted(known, edges * classes)
    slots = (slots - label_starts[tile_of]).to(torch.int32)
    own_labels = (known % classes - 1).to(torch.int32)
    for first, last in frame.tile_runs(lists):
        launch(
            _strongest, last - first, *lists.splats, lists.starts, lists.items, frame.scratch(last - first),
            slots, label_starts, own_labels, image, lists.first_tile, first, *frame.size, *frame.cuts,
            KIND=frame.kind, COLUMNS=NARROWEST,
        )  # fmt: skip
