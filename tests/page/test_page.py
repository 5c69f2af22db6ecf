"""The page, as somebody uses it: words, clicks, links and keys."""

from __future__ import annotations

import json

import pytest

from service.scopes import Scope
from service.store.keys import Quota

from .browser import Browser
from .conftest import Served

SHOWN = "document.querySelector('#render').naturalWidth === 32"
ANSWERED = "document.querySelector('#mask').dataset.ready && document.querySelector('#attention').dataset.ready"
TROUBLE = "!document.querySelector('#trouble').hidden"
PICKS = "[...document.querySelectorAll('#picks button')].map(button => button.textContent)"
FOUND = """(() => {
  const canvas = document.querySelector('#mask');
  const pixels = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
  const clear = [];
  for (let i = 0; i < pixels.length; i += 4) if (pixels[i + 3] === 0) clear.push(i / 4 % canvas.width);
  return clear;
})()"""


def text_of(browser: Browser, selector: str) -> str:
    return browser.value(f"document.querySelector('{selector}').textContent")


@pytest.fixture
def page(browser: Browser, served: Served) -> Browser:
    browser.open(served.address)
    browser.until(SHOWN)
    return browser


def test_lifts_jobs_and_uploads_are_listed_and_the_first_view_is_shown(page: Browser, served: Served) -> None:
    assert served.lift[:8] in text_of(page, "#lifts") and "60" in text_of(page, "#lifts")
    assert "succeeded" in text_of(page, "#jobs") and "row-sum" in text_of(page, "#jobs")
    assert page.value("[...document.querySelector('#view').options].map(option => option.value)") == [
        "left", "middle", "right"
    ]  # fmt: skip
    assert page.value("document.querySelectorAll('#assets tr').length") == 3
    assert page.value("document.querySelector('#asked').hidden") is False
    assert page.value(TROUBLE) is False


def test_word_finds_its_thing_in_the_picture(page: Browser) -> None:
    page.write("#text", "lamp")
    page.press("#query button")
    page.until(ANSWERED)
    assert "splats at or above" in text_of(page, "#answer")
    columns = page.value(FOUND)
    assert columns and min(columns) > 16  # the lamp is the right one of three
    page.until("document.querySelector('#numbers').textContent.includes('object 1')")
    assert "splats around (1." in text_of(page, "#numbers") and "object 2" not in text_of(page, "#numbers")
    assert page.value("getComputedStyle(document.querySelector('#mask')).display") != "none"
    page.press("#show-mask")
    assert page.value("document.querySelector('#mask').hidden") is True
    page.press("#show-attention")
    assert page.value("document.querySelector('#attention').hidden") is False


def test_click_asks_for_more_of_it_and_shift_for_less(page: Browser) -> None:
    page.press("#render", 7.5 / 32, 12.5 / 24)
    page.until(ANSWERED)
    assert page.value(PICKS) == ["like left:7,12 \u00d7"]
    left = page.value(FOUND)
    assert left and max(left) < 16
    page.press("#render", 25.5 / 32, 12.5 / 24, shift=True)
    page.until(f"{PICKS}.length === 2")
    assert page.value(PICKS)[1] == "unlike left:25,12 \u00d7"
    page.until(ANSWERED)
    assert page.value("document.querySelectorAll('#stage .point').length") == 2
    page.press("#picks button")
    page.until(f"{PICKS}.length === 1")


def test_example_that_nothing_understands_is_told_and_taken_back(page: Browser) -> None:
    page.write("#example", "nowhere:1,1")
    page.press("#more")
    page.until(TROUBLE)
    assert "nowhere" in text_of(page, "#trouble")
    assert page.value(PICKS) == []


def test_words_of_users_never_become_markup(page: Browser) -> None:
    page.write("#text", "<img src=x onerror=alert(1)>")
    page.press("#query button")
    page.until(TROUBLE)
    assert "<img src=x" in text_of(page, "#trouble")
    assert page.value("document.querySelectorAll('#trouble *').length") == 0


def test_running_lift_shows_its_stage_and_its_plan(page: Browser) -> None:
    plan = {"summary": ["60 splats", "8 channels"], "warnings": ["little <b>memory</b>"]}
    job = {"state": "running", "plan": plan, "progress": {"stage": "compile", "done": 0, "total": 1, "unit": "steps"}}
    page.value(f"document.body.append(progress({json.dumps(job)}))")
    shown = "[...document.querySelectorAll('.plan li')].map(line => line.textContent)"
    assert page.value(shown) == ["60 splats", "8 channels", "warning: little <b>memory</b>"]
    assert text_of(page, "body > div:last-child").startswith(" compile60 splats")


def test_link_opens_a_question(browser: Browser, served: Served) -> None:
    browser.open(f"{served.address}/?lift={served.lift}&view=right&text=apple&layer=attention&what=pca")
    browser.until(ANSWERED)
    shown = "['view', 'what', 'text'].map(name => document.querySelector(`#${name}`).value)"
    assert browser.value(shown) == ["right", "pca", "apple"]
    assert browser.value("[document.querySelector('#attention').hidden, document.querySelector('#mask').hidden]") == [
        False, True
    ]  # fmt: skip


def test_page_asks_for_a_key_where_one_is_needed(page: Browser, served: Served) -> None:
    """The last one: from here on the service is closed."""
    key, secret = served.store.keys.create("page", frozenset({Scope.READ}), Quota())
    try:
        page.until("!document.querySelector('#door').hidden")
        page.write("#key", "wrong")
        page.value("document.body.dataset.old = true")  # it tells trouble and shows the door until it is gone
        page.press("#door button")
        page.until(f"!document.body.dataset.old && {TROUBLE} && !document.querySelector('#door').hidden")
        page.write("#key", secret)
        page.press("#door button")
        page.until(f"!({TROUBLE}) && document.querySelectorAll('#jobs tr').length === 1")
        assert "none yet" in text_of(page, "#lifts")  # another's are not shown
    finally:
        served.store.keys.revoke(key.id)
