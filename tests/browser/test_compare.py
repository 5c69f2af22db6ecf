"""Two sides with one camera: words and cuts beside each other."""

from __future__ import annotations

import pytest

from .browser import Browser
from .conftest import PageServer
from .looking import AMBER, READY, ask, columns, text_of

pytestmark = pytest.mark.slow
COMPARE = "#panel-ask [data-compare]"
BOTH_SETTLED = "splatlift.comparison.isLoaded && splatlift.comparison.left.settled && splatlift.viewer.settled"
PLACES = "[splatlift.viewer, splatlift.comparison.left].map(side => side.place3d)"
SAME_PLACE = "(([one, other]) => one.every((value, axis) => Math.abs(value - other[axis]) < 1e-6))"
SHARED = f"{BOTH_SETTLED} && {SAME_PLACE}({PLACES})"


@pytest.fixture
def page(browser: Browser, server: PageServer) -> Browser:
    browser.window(1200, 700)
    browser.open(server.address)
    browser.until(READY)
    return browser


def test_two_words_are_seen_beside_each_other_with_one_camera(page: Browser) -> None:
    ask(page, "lamp")
    page.press(COMPARE)
    page.until(SHARED)
    ask(page, "apple")
    assert "lamp" in text_of(page, "#beside-said") and "apple" in text_of(page, "#chips")
    right, left = (columns(page, AMBER, canvas=canvas) for canvas in ("#scene", "#beside"))
    assert max(right) < 50 < min(left)  # the apple is left of the lamp
    before = page.value(PLACES)
    for side in ("#scene", "#beside"):  # either turns both
        page.drag(side, (0.5, 0.5), (0.7, 0.5))
        page.until(SHARED)
        assert page.value(PLACES) != before
        before = page.value(PLACES)
    page.window(390, 844)
    page.until(SHARED)
    assert page.value("document.documentElement.scrollWidth") == 390
    over, below = (
        page.value(f"document.querySelector('{side}').getBoundingClientRect().y") for side in ("#beside", "#scene")
    )
    assert over < below
    assert page.violations() == {}
    page.press("#end-compare")
    assert page.value("document.querySelector('#beside').checkVisibility()") is False


def test_link_opens_both_sides_and_back_leaves_one(page: Browser) -> None:
    ask(page, "lamp")
    page.press(COMPARE)
    page.until(BOTH_SETTLED)
    page.value("document.querySelector('#cut').value = document.querySelector('#cut').max")
    for event in ("input", "change"):
        page.value(f"document.querySelector('#cut').dispatchEvent(new Event('{event}'))")
    page.until(f"location.search.includes('threshold') && {BOTH_SETTLED}")
    sides = "['#beside-said', '#chips'].map(side => document.querySelector(side).textContent)"
    left, right = page.value(sides)
    assert left != right and "lamp" in left and "lamp" in right
    address = page.value("location.href")
    page.open("about:blank#")
    page.open(address)
    page.until(f"{READY} && {BOTH_SETTLED} && splatlift.query.current.answer")
    assert page.value(sides) == [left, right]
    page.press("#end-compare")
    page.until("!location.search.includes('beside')")
    page.value("history.back()")
    page.until(BOTH_SETTLED)
