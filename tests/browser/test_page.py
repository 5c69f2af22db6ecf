"""The page, as somebody uses it: words, clicks, keys, links, files. What is seen is counted in pixels."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import liftcore as lc
from service.store import create_key, open_keys, revoke_key

from .browser import Browser, Chromium, launch, profile
from .conftest import PageServer
from .looking import AMBER, BOTH_SETTLED, FIND_COLOUR, READY, SKY, ask, columns, splat_at, text_of

EXAMPLES = "splatlift.query.questions.flatMap(asked => [...asked.like, ...asked.unlike.map(term => `not ${term}`)])"
SETS = "splatlift.query.questions.flatMap(asked => asked.wordOf ?? asked.sets)"
WORDS = "splatlift.query.questions.flatMap(asked => asked.text)"
APPLE, LAMP = 5, 45  # splats of these
CLEAR = """(() => {
  const canvas = document.querySelector('#mask');
  const pixels = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
  const clear = [];
  for (let i = 0; i < pixels.length; i += 4) {
    if (pixels[i + 3] === 0 || pixels[i] > 128) clear.push(i / 4 % canvas.width);
  }
  return clear;
})()"""
COMPARE = "#panel-ask [data-compare]"
PLACES = "[splatlift.viewer, splatlift.comparison.left].map(side => side.place3d)"
SAME_PLACE = "(([one, other]) => one.every((value, axis) => Math.abs(value - other[axis]) < 1e-6))"
SHARED = f"{BOTH_SETTLED} && {SAME_PLACE}({PLACES})"
MODE_VIEW = "input[name=mode][value=view] + span"
BOXES = """['#render', '#mask'].map(name => {
  const { left, top, width, height } = document.querySelector(name).getBoundingClientRect();
  return [left, top, width, height];
})"""


@pytest.fixture
def page(browser: Browser, server: PageServer) -> Browser:
    browser.window(1200, 700)
    browser.open(server.address)
    browser.until(READY)
    return browser


def reset_view(page: Browser) -> None:
    page.press("#reset-view")
    page.until("splatlift.viewer.settled")


def test_first_view_is_shown_in_3d_with_its_lists(page: Browser, server: PageServer) -> None:
    visible_columns = columns(page)
    assert visible_columns and min(visible_columns) < 40 and max(visible_columns) > 60  # three clusters side by side
    assert page.value("[...document.querySelector('#view').options].map(option => option.value)") == [
        "left", "middle", "right"
    ]  # fmt: skip
    assert page.value("document.querySelector('#lift').value") == server.lift
    assert "60 splats" in text_of(page, "#about")
    page.until("splatlift.objects.items.length === 3")
    assert sorted(page.value("splatlift.objects.items.map(object => object.name)")) == ["apple", "book", "lamp"]


def test_word_lights_its_object(page: Browser) -> None:
    before = columns(page)
    ask(page, "lamp")
    lit_columns = columns(page, AMBER)
    assert lit_columns and min(lit_columns) > 50  # the lamp is the right one of three
    assert "splats of 60" in text_of(page, "#answer") and "the total weight at or above" in text_of(page, "#why")
    assert page.value("document.querySelectorAll('#objects li').length") == 1
    assert text_of(page, "#labels .label") == "lamp"
    painted = "splatlift.query.paintedQuestions()[0].scores"
    assert page.value(f"{painted}.filter(score => score >= splatlift.query.current.cut - 1e-6).length") == page.value(
        "splatlift.query.current.answer.count"
    )
    page.press("#hide")
    assert min(columns(page)) > 50  # the rest is hidden
    page.press("#hide")
    page.press("#clear")
    after = columns(page)
    assert sorted(after) == sorted(before)  # to the pixel


def test_slider_repaints_without_a_request(page: Browser) -> None:
    ask(page, "lamp")
    lit_columns, requests = len(columns(page, AMBER)), len(page.requests)
    page.value("document.querySelector('#cut').value = 9")  # the most there is
    page.value("document.querySelector('#cut').dispatchEvent(new Event('input'))")
    assert len(page.requests) == requests and "You set this threshold." in text_of(page, "#why")
    assert page.value("document.querySelectorAll('#objects button').length") == 0  # those of the cut before
    assert text_of(page, ".chip small") == str(page.value("splatlift.query.current.count"))
    assert len(columns(page, AMBER)) < lit_columns
    page.until(FIND_COLOUR)  # the objects follow
    page.press("#auto")
    page.until(FIND_COLOUR)
    assert len(columns(page, AMBER)) == lit_columns


def test_several_words_have_a_colour_each(page: Browser) -> None:
    ask(page, "lamp, apple")
    assert min(columns(page, AMBER)) > 50 > max(columns(page, SKY))
    page.press(".chip .away")
    assert page.value(WORDS) == ["apple"]
    page.key("Escape")
    assert page.value(WORDS) == []


def test_box_completes_maps_and_suggests_words(page: Browser) -> None:
    page.until("document.querySelectorAll('#here-words button').length === 3")  # the three objects
    page.write("#words", "app")
    page.until("document.querySelector('#completions li')")
    assert text_of(page, "#completions") == "apple"
    page.key("ArrowDown")
    page.key("Enter")
    page.until(FIND_COLOUR)
    assert page.value(WORDS) == ["apple"] and page.value("document.querySelector('#advice').hidden") is True
    ask(page, "the red apples")
    assert text_of(page, "#advice") == "\u201cthe red apples\u201d is matched to apple."
    page.write("#words", "boook")
    page.press("#query button.main")
    page.until("splatlift.query.current?.problem")
    page_text = page.value("document.body.innerText")
    assert (
        "\u201cboook\u201d is not in the list of words" in page_text
        and "text.0" not in page_text
        and ".safetensors" not in page_text
    )
    page.press("#advice button")
    page.until(FIND_COLOUR)
    assert page.value(WORDS) == ["book"]
    page.write("#words", "<img src=x onerror=alert(1)>")  # words of users never become markup
    page.press("#query button.main")
    page.until("splatlift.query.current?.problem")
    assert "<img src=x" in text_of(page, "#advice")
    assert page.value("document.querySelectorAll('#advice img, #chips img, #found img').length") == 0


def test_click_takes_the_object_and_another_its_patch(page: Browser) -> None:
    page.until("splatlift.objects.items.length === 3")
    page.press("#scene", *splat_at(page, APPLE))
    page.until(f"{SETS}.length === 1")
    page.until(FIND_COLOUR)
    assert page.value("splatlift.query.current.count") == 20 and columns(page, AMBER)
    assert text_of(page, "#chips .chip").startswith("apple") and page.value(WORDS) == ["apple"]  # as well as its word
    reset_view(page)
    page.press("#scene", *splat_at(page, LAMP), shift=True)
    page.until(f"{SETS}.length === 2")
    page.until(FIND_COLOUR)
    assert page.value("splatlift.query.current.count") == 40
    assert page.value("document.querySelectorAll('#scene-objects-list [aria-pressed=true]').length") == 2
    reset_view(page)
    page.press("#scene", *splat_at(page, LAMP))
    page.until(f"{SETS}.length === 1 && {FIND_COLOUR}")
    reset_view(page)
    page.press("#scene", *splat_at(page, LAMP))
    page.until(f"{EXAMPLES}.length === 1 && !{SETS}.length")


@pytest.fixture
def scene_with_parts(server: PageServer, tmp_path: Path) -> Iterator[str]:
    """A lift whose lamp has two parts, nodes 3 and 4: its splats of even and of odd rows."""
    (tmp_path / "lift").write_bytes(server.client.get(f"/lifts/{server.lift}/features").content)
    lift = lc.load_lift(tmp_path / "lift")
    assert lift.object is not None
    lamp, rows, tree = int(lift.object[LAMP]), torch.nonzero(lift.object == lift.object[LAMP])[:, 0], dict[str, Any]()
    tree["node"] = lift.object.index_copy(0, rows, (3 + rows % 2).int())
    tree["node_parents"] = torch.tensor([-1, -1, -1, lamp, lamp]).int()
    for name in ("node_views", "node_confidence", "node_features"):
        tree[name] = getattr(lift, name)[[0, 1, 2, lamp, lamp]]
    replace(lift, **tree).save(tmp_path / "parts")
    content = (tmp_path / "parts").read_bytes()
    lifted = server.client.post("/lifts", content=content).raise_for_status().json()["id"]
    yield lifted
    server.client.delete(f"/jobs/{lifted}?with_lift=true").raise_for_status()


def test_objects_unfold_into_parts_by_keyboard_and_by_clicks(
    page: Browser, server: PageServer, scene_with_parts: str
) -> None:
    page.open(f"{server.address}/?lift={scene_with_parts}")
    page.until(f"{READY} && splatlift.objects.nodes.size === 5")
    unfold = "document.querySelector('#scene-objects-list [aria-expanded]')"
    assert page.value(f"{unfold}.getAttribute('aria-label')") == "2 parts of lamp"
    page.value(f"{unfold}.focus()")
    page.key("Enter")
    page.until("document.querySelectorAll('#scene-objects-list .parts li').length === 2")
    assert page.value(f"document.activeElement === {unfold} && {unfold}.getAttribute('aria-expanded')") == "true"
    page.press("#scene-objects-list .parts .object")
    page.until(f"{SETS}.join() === 'object:3' && {FIND_COLOUR}")
    assert page.value("splatlift.query.current.count") == 10 and text_of(page, "#chips .chip").startswith(
        "part 1 of the lamp"
    )
    page.press("#clear")
    reset_view(page)
    object_id, part = f"object:{page.value('splatlift.objects.nodes.get(3).parent')}", "object:4"
    at = splat_at(page, LAMP)
    for set_id in (object_id, part):
        page.press("#scene", *at)
        page.until(f"{SETS}.join() === '{set_id}' && {FIND_COLOUR}")
    page.press("#scene", *at, alt=True)
    page.until(f"{EXAMPLES}.join() === 'splat:{LAMP}'")
    page.press("#clear")
    page.press(MODE_VIEW)
    page.until("document.querySelector('#render').naturalWidth === 32")
    page.press("#render", 27.5 / 32, 12.5 / 24)
    page.until(f"{SETS}.join() === '{object_id}' && {FIND_COLOUR}")
    page.press("#render", 27.5 / 32, 12.5 / 24)
    page.until(f"['object:3', 'object:4'].includes({SETS}.join()) && {FIND_COLOUR}")


def test_object_takes_a_name_by_which_it_is_found(page: Browser, server: PageServer) -> None:
    first = "document.querySelector('#scene-objects-list .object span').firstChild.textContent"
    page.until("splatlift.objects.items.length === 3")
    page.press("#scene-objects-list [title='Name this object']")
    page.write("#scene-objects-list input", "Garfield")
    page.key("Enter")
    page.until(f"{first} === 'Garfield'")
    page.open(server.address)
    page.until(f"{READY} && splatlift.objects.items.length === 3")
    ask(page, "garfield, lamp")
    assert page.value("splatlift.query.questions.map(asked => asked.count)") == [20, 20]
    assert page.value(SETS) == ["object:0"] and text_of(page, "#chips .chip").startswith("Garfield")
    server.client.patch(f"/lifts/{server.lift}/objects/0", json={"name": None}).raise_for_status()


def test_hidden_object_is_neither_drawn_nor_clicked(page: Browser, server: PageServer) -> None:
    page.until("splatlift.objects.items.length === 3")
    place = splat_at(page, LAMP)
    assert max(columns(page)) > 60
    page.press("#scene-objects-list [aria-label='Hide lamp']")
    page.until("document.querySelectorAll('#scene-objects-list li').length === 2")
    for _ in range(2):
        page.until("splatlift.viewer.settled")
        assert max(columns(page)) < 60
        page.press("#scene", *place)
        page.until("document.querySelector('#toast').textContent === 'There is no splat at this point.'")
        page.open(server.address)  # for good
        page.until(f"{READY} && splatlift.objects.items.length === 3")
        assert page.value("document.querySelectorAll('#scene-objects-list li').length") == 2
    page.press("#scene-objects-hidden")
    page.press("#scene-objects-list [aria-label='Show lamp']")
    page.until("!splatlift.objects.items.some(object => object.hidden) && splatlift.viewer.settled")
    assert max(columns(page)) > 60


def test_answer_is_corrected_by_hand_and_undone(page: Browser) -> None:
    is_done = f"splatlift.editor.selection?.step === {{}} && !splatlift.editor.isBusy && {FIND_COLOUR}"
    ask(page, "lamp")
    lamp = page.value("splatlift.query.current.count")
    page.press("#by-hand")
    page.until(is_done.format(0))
    assert page.value("splatlift.query.current.count") == lamp
    assert page.value("document.querySelector('#hand').hidden") is False
    x, y = splat_at(page, APPLE)
    page.drag("#scene", (x, y - 0.2), (x, y + 0.2))
    page.until(is_done.format(1))
    total = page.value("splatlift.query.current.count")
    assert lamp < total and min(columns(page, AMBER)) < 50  # the apple's side lights up too
    page.value("history.back()")
    page.until(is_done.format(0))
    assert page.value("splatlift.query.current.count") == lamp and min(columns(page, AMBER)) > 50
    page.key("z", ctrl=True, shift=True)
    page.until(is_done.format(1))
    page.key("z", ctrl=True)
    page.until(is_done.format(0))
    link = page.value("location.href")
    page.drag("#scene", (x, y - 0.2), (x, y + 0.2), alt=True)  # nothing of it is selected
    page.until(is_done.format(1))
    assert page.value("splatlift.query.current.count") == lamp
    page.open(link)
    page.until(f"{READY} && {is_done.format(0)}")
    assert page.value("splatlift.query.current.count") == lamp and text_of(page, "#chips .chip").startswith("lamp")
    page.value("[...document.querySelectorAll('#hand button')].find(button => button.textContent === 'Done').click()")
    page.press("#by-hand")  # and on
    assert page.value("document.querySelector('#hand').hidden") is False
    assert page.value("splatlift.objects.selections.length") == 1


def test_back_undoes_what_was_asked_and_stays_on_the_page(page: Browser) -> None:
    before = page.value("history.length")
    ask(page, "lamp")
    ask(page, "apple")
    page.press("#objects .object")
    assert page.value("history.length") == before + 2  # looking is no entry
    page.value("history.back()")
    page.until(f"{WORDS}.join() === 'lamp' && {FIND_COLOUR}")
    page.value("history.back()")
    page.until("!splatlift.query.questions.length && splatlift.viewer.settled")
    page.value("history.forward()")
    page.until(f"{WORDS}.join() === 'lamp' && {FIND_COLOUR}")
    assert page.value("document.querySelector('#words').value") == "lamp"


def test_click_asks_for_more_and_shift_for_less(page: Browser) -> None:
    page.press("#scene", *splat_at(page, APPLE), alt=True)
    page.until(f"{EXAMPLES}.length === 1")
    page.until(FIND_COLOUR)
    assert page.value(EXAMPLES)[0].startswith("splat:") and int(page.value(EXAMPLES)[0][6:]) < 20  # the apple
    assert max(columns(page, AMBER)) < 50
    page.press("#scene", *splat_at(page, LAMP), shift=True)
    page.until(f"{EXAMPLES}.length === 2")
    page.until(FIND_COLOUR)
    assert page.value(EXAMPLES)[1].startswith("not splat:")
    page.press("#examples button")
    page.until(f"{EXAMPLES}.length === 0")
    page.press("#scene", *splat_at(page, APPLE), alt=True)
    page.until(FIND_COLOUR)
    ask(page, "lamp")
    assert page.value(EXAMPLES) == [] and page.value(WORDS) == ["lamp"]  # words after a click ask the words


def test_two_words_are_seen_beside_each_other_with_one_camera_and_by_a_link(page: Browser) -> None:
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
    over, below = (
        page.value(f"document.querySelector('{side}').getBoundingClientRect().y") for side in ("#beside", "#scene")
    )
    assert over < below
    page.window(1200, 700)
    page.until(BOTH_SETTLED)
    page.value("document.querySelector('#cut').value = document.querySelector('#cut').max")
    for event in ("input", "change"):
        page.value(f"document.querySelector('#cut').dispatchEvent(new Event('{event}'))")
    page.until(f"location.search.includes('threshold') && {BOTH_SETTLED}")
    sides = "['#beside-said', '#chips'].map(side => document.querySelector(side).textContent)"
    left, right = page.value(sides)
    assert "lamp" in left and "apple" in right
    address = page.value("location.href")
    page.open("about:blank#")
    page.open(address)
    page.until(f"{READY} && {BOTH_SETTLED} && splatlift.query.current.answer")
    assert page.value(sides) == [left, right]
    page.press("#end-compare")
    page.until("!location.search.includes('beside')")
    page.value("history.back()")
    page.until(BOTH_SETTLED)
    page.press("#end-compare")
    assert page.value("document.querySelector('#beside').checkVisibility()") is False


def test_everything_is_named_and_one_word_is_seen_alone(page: Browser) -> None:
    page.press("#tab-name")
    page.press("#naming button.main")
    page.until("document.querySelectorAll('#legend button').length === 3 && splatlift.viewer.settled")
    assert text_of(page, "#named").startswith("3 words of 3 label splats")
    names = page.value("[...document.querySelectorAll('#labels .label')].map(label => label.textContent)")
    assert sorted(names) == ["apple", "book", "lamp"]
    legend = page.value("[...document.querySelectorAll('#legend button')].map(line => line.textContent)")
    lamp = next(place for place, line in enumerate(legend) if line.startswith("lamp")) + 1
    colour = page.value(f"splatlift.labels.segmentation.named_words[{lamp - 1}].colour.join()")
    page.press(f"#legend li:nth-child({lamp}) button")
    assert page.value("[...document.querySelectorAll('#labels .label')].map(label => label.textContent)") == ["lamp"]
    lit_columns = columns(page, colour, near=0.6)  # as it is blended with the splats' own
    assert lit_columns and min(lit_columns) > 50  # the lamp is the right one of three
    assert "named=*" in page.value("location.search") and "only=lamp" in page.value("location.search")
    page.open(page.value("location.href"))  # the link tells all of it
    is_restored = "splatlift.labels.isShown && splatlift.labels.selectedValues.size === 1 && splatlift.viewer.settled"
    page.until(f"{is_restored} && document.querySelectorAll('#legend button').length === 3")
    page.write("#own-words", "lamp, book")
    page.press("#naming button.main")
    page.until("document.querySelectorAll('#legend button').length === 2")
    page.press("#tab-ask")
    ask(page, "lamp")
    assert page.value("splatlift.labels.isShown") is False and min(columns(page, AMBER)) > 50


def test_page_works_by_keyboard_alone(page: Browser) -> None:
    page.key("/")
    assert page.value("document.activeElement.id") == "words"
    page.write("#words", "lamp")
    page.key("Enter")
    page.until(FIND_COLOUR)
    page.value("document.querySelector('#scene').focus()")
    before = page.value("splatlift.viewer.place3d")
    for key in ("ArrowLeft", "ArrowUp", "+"):
        page.key(key)
        after = page.value("splatlift.viewer.place3d")
        assert after != before, key
        before = after
    page.key("h")
    assert page.value("document.querySelector('#hide').checked") is True
    page.key("]")
    assert page.value("document.querySelector('#view').value") == "middle"
    page.key("Enter")  # the book lies in the middle
    page.until(f"{SETS}.length === 1 && {FIND_COLOUR}")
    assert text_of(page, "#chips .chip").startswith("book")
    page.key("?")
    assert page.value("document.querySelector('#help').open") is True


def test_link_opens_question_layer_and_camera_again(page: Browser, server: PageServer) -> None:
    ask(page, "apple, lamp")
    page.value("document.querySelector('#scene').focus()")
    page.key("ArrowRight")
    page.press("#tab-look")
    page.press("#panel-look input[value=pca]")
    page.until("location.search.includes('layer=pca')")
    link, place = page.value("location.href"), page.value("splatlift.viewer.place3d")
    page.open("about:blank#")
    page.open(link)
    page.until(READY)
    page.until(FIND_COLOUR)
    assert page.value(WORDS) == ["apple", "lamp"] and page.value("splatlift.layers.layerName") == "pca"
    assert page.value("splatlift.viewer.place3d") == pytest.approx(place, rel=1e-3, abs=1e-3)
    rest = "instances=2&keep=largest&odd=1"
    page.open(f"{server.address}/?lift={server.lift}&view=right&text=apple&threshold=0.5&layer=odd&show=odd&{rest}")
    page.until(READY)
    page.until(FIND_COLOUR)
    assert page.value("[splatlift.layers.view.name, splatlift.query.current.cut]") == ["right", 0.5]
    fields = dict(page.value("[...splatlift.query.requestParameters(splatlift.query.current)]"))
    parameters = {
        "threshold": "0.5",
        "instances": "2",
        "keep": "largest",
        "absent": "keep",
    }  # a cut holds all the same
    assert fields == {"lift": server.lift, "text": "apple", **parameters}
    assert "instances=2" in page.value("location.search") and "odd=1" not in page.value("location.search")
    assert page.value("[splatlift.layers.layerName, splatlift.layers.mode]") == ["rgb", "scene"]


def test_link_to_a_scene_that_is_gone_leaves_the_others_to_choose(page: Browser, server: PageServer) -> None:
    page.open(f"{server.address}/?lift={'0' * 32}")
    page.until("!document.querySelector('#trouble').hidden")
    assert text_of(page, "#lift option:checked") == "Choose a scene"
    choose = "(scenes => { scenes.selectedIndex = 1; scenes.dispatchEvent(new Event('change')); })"
    page.value(f"{choose}(document.querySelector('#lift'))")
    page.until(READY)
    assert page.value("document.querySelector('#lift').options.length") == 1


def test_photo_view_shows_the_mask_and_takes_examples(page: Browser) -> None:
    page.press("#tools input[value=view] + span")
    page.until("document.querySelector('#render').naturalWidth === 32")
    ask(page, "lamp")
    page.until("!document.querySelector('#mask').hidden")
    assert min(page.value(CLEAR)) > 16
    page.press("#render", 7.5 / 32, 12.5 / 24, alt=True)
    page.until(f"{EXAMPLES}.length === 1")
    assert page.value(EXAMPLES) == ["left:7,12"]
    page.until("document.querySelectorAll('#picture .mark').length === 1")
    page.drag("#render", (20.5 / 32, 2.5 / 24), (29.5 / 32, 21.5 / 24), shift=True)
    page.until("splatlift.query.current.unlike.length === 1")
    assert page.value("splatlift.query.current.unlike") == ["left:box:20,2,30,22"]
    page.until(FIND_COLOUR)
    page.until("document.querySelectorAll('#picture .mark').length === 2")
    box = page.value("document.querySelector('#picture .mark.box.unlike').getBoundingClientRect().toJSON()")
    picture = page.value("document.querySelector('#render').getBoundingClientRect().toJSON()")
    assert (box["left"] - picture["left"]) / picture["width"] == pytest.approx(20 / 32, abs=0.01)
    assert box["width"] / picture["width"] == pytest.approx(10 / 32, abs=0.03)
    page.value("document.querySelector('#mask').width = 3200")  # as many pixels as a window does not have
    for width, height in ((1200, 700), (1000, 500), (390, 844)):
        page.window(width, height)
        picture, mask = page.value(BOXES)
        assert mask == pytest.approx(picture, abs=0.1), (width, height)


def test_page_without_webgl_shows_the_views(chromium: Chromium, server: PageServer) -> None:
    with (
        launch(chromium.browser_type, "--disable-3d-apis") as program,
        profile(program) as context,
        Browser.open_window(context) as browser,
    ):
        browser.open(server.address)
        browser.until("globalThis.splatlift?.lift && document.querySelector('#render').naturalWidth === 32")
        assert browser.value("document.querySelector('#stage').dataset.mode") == "view"
        ask(browser, "lamp")
        browser.until("!document.querySelector('#mask').hidden")
        assert min(browser.value(CLEAR)) > 16


@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_accessibility_check_finds_nothing_serious(page: Browser, scheme: str) -> None:
    page.window(1280, 800, scheme)
    ask(page, "lamp")
    for tab in ("ask", "name", "look", "bring", "take"):
        page.press(f"#tab-{tab}")
        if tab == "name":
            page.press("#naming button.main")
            page.until("document.querySelector('#legend button')")
        assert page.violations() == {}, tab


def test_lines_to_take_away_ask_the_same(page: Browser) -> None:
    page.write("#but", "book")
    ask(page, "apple")
    page.write("#but", "lamp")  # which was not asked
    page.press("#tab-take")
    assert "text=apple" in text_of(page, "#curl") and "negatives=book" in text_of(page, "#curl")
    names: dict[str, Any] = {}
    exec(text_of(page, "#python"), names)  # over HTTP, as this encoder is a table of the server
    assert names["answer"]["count"] == page.value("splatlift.query.current.count") > 0
    assert names["answer"]["threshold"]["value"] == pytest.approx(page.value("splatlift.query.current.cut"))
    addresses = ["object", "objects", "mask", "scores"]
    requests = (
        f"{json.dumps(addresses)}.map(what => fetch(splatlift.exporter.address(what)).then(reply => reply.status))"
    )
    assert page.value(f"Promise.all({requests})") == [200] * 4


def revoke(server: PageServer, key: str) -> None:
    with open_keys(server.data) as keys:
        revoke_key(keys, key)


def test_page_asks_for_a_key_where_one_is_needed(page: Browser, server: PageServer) -> None:
    """From here on the service is closed."""
    with open_keys(server.data) as keys:
        key, secret = create_key(keys, "page", "read")
    try:
        page.open(server.address)
        page.until("document.querySelector('#door').open")
        page.write("#key", "wrong")
        page.value("document.body.dataset.old = true")
        page.press("#use-key")
        page.until("!document.body.dataset.old && document.querySelector('#door').open")
        assert page.value("document.querySelector('#door-wrong').hidden") is False
        page.write("#key", secret)
        page.press("#use-key")
        page.until("globalThis.splatlift && !document.querySelector('#empty').hidden")  # another's are not shown
        assert page.value("document.querySelector('#door').open") is False
    finally:
        revoke(server, key.id)


def test_shared_scene_is_asked_by_its_link_and_changed_by_nobody(browser: Browser, server: PageServer) -> None:
    """An owner makes the link on the page; who has it sees that scene, and nothing to change it with."""
    with open_keys(server.data) as keys:
        owner, secret = create_key(keys, "owner", "admin")
    try:
        browser.open(f"{server.address}/?lift={server.lift}#key={secret}")
        browser.until(f"{READY} && !location.hash && document.querySelector('#whose').textContent === 'owner'")
        browser.press("#tab-take")
        browser.write("#share-name", "Bob")
        browser.press("#share button")
        browser.until("document.querySelectorAll('#shares li').length === 1")
        link = browser.value("document.querySelector('#share-link').value")
        browser.value("sessionStorage.clear()")
        browser.open("about:blank#")
        browser.open(link)
        browser.until(f"{READY} && document.querySelector('#whose').textContent.startsWith('Shared with Bob until')")
        assert browser.value("location.href").startswith(f"{server.address}/?lift={server.lift}")
        assert link.partition("#key=")[2] not in browser.value("location.href + document.cookie")
        for selector in ("#tab-bring", "#sharing", "#by-hand", "#scene-objects-list .edit"):
            visible_columns = f"[...document.querySelectorAll('{selector}')].some(one => one.checkVisibility())"
            assert browser.value(visible_columns) is False, selector
        ask(browser, "lamp")
        assert columns(browser, AMBER)
        revoke(server, owner.id)
        browser.open(f"{server.address}/?again")
        browser.until("document.querySelector('#door').open")
    finally:
        revoke(server, owner.id)
        browser.value("sessionStorage.clear()")
