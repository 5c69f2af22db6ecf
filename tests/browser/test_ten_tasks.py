"""Tasks of a new user: open the example, find objects, correct, name and export them, compare two words, and open
the same state by a link.

Set SPLATLIFT_PICTURES to a folder to have a picture of each step.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zstandard

from service.routes import operations
from tests.tiny_scene import make_scene

from .browser import Browser
from .conftest import PageServer, serving
from .looking import AMBER, FIND_COLOUR, READY, ask, columns, splat_at, text_of

pytestmark = pytest.mark.slow
APPLE = 5  # a splat of it
SAVE_OBJECTS = "splatlift.exporter.saveLabels(true).then(() => document.querySelector('#toast').textContent)"
BOTH_SETTLED = "splatlift.comparison.isLoaded && splatlift.comparison.left.settled && splatlift.viewer.settled"


@pytest.fixture
def empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A service without a lift, which ships a small example."""
    scene, example = make_scene(), tmp_path / "example"
    example.mkdir()
    (example / "point_cloud.spz").write_bytes(scene.splats)
    (example / "cameras.json").write_bytes(scene.cameras)
    (example / "features.safetensors.zst").write_bytes(zstandard.compress(scene.features))
    (tmp_path / "table.safetensors").write_bytes(scene.table)
    monkeypatch.setattr(operations, "EXAMPLE", example)
    with serving(tmp_path / "data", encoder=f"table:{tmp_path}/table.safetensors") as address:
        yield address


def pictures(page: Browser, width: int) -> Callable[[str], None]:
    folder = os.environ.get("SPLATLIFT_PICTURES")

    def save(name: str) -> None:
        assert page.value("document.documentElement.scrollWidth") <= width, name
        assert page.violations() == {}, name
        if folder:
            page.page.screenshot(path=Path(folder) / f"{width}-{name}.png")

    return save


def test_example_opens_by_its_button(browser: Browser, empty: str) -> None:
    browser.window(1440, 900)
    browser.open(empty)
    browser.until("!document.querySelector('#empty').hidden")
    browser.press("#open-example")
    browser.until(READY)
    ask(browser, "lamp")
    assert len(columns(browser, AMBER)) > 50
    pictures(browser, 1440)("1-example")


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (390, 844)])
def test_ten_tasks_are_done_without_a_manual(
    browser: Browser, server: PageServer, empty: str, tmp_path: Path, width: int, height: int
) -> None:
    page, save_picture = browser, pictures(browser, width)
    page.window(width, height)
    page.open(empty)  # open the example
    page.until("!document.querySelector('#empty').hidden")
    save_picture("0-empty")
    assert page.value("document.querySelector('#open-example').checkVisibility()") is True
    page.open(f"{server.address}/?lift={server.lift}")
    page.until(READY)
    for word in ("book", "apple", "lamp"):  # find three things
        ask(page, word)
        assert len(columns(page, AMBER)) > 50
    save_picture("2-found")
    page.press("#by-hand")  # correct one
    page.until(f"splatlift.editor.selection?.version && {FIND_COLOUR}")
    save_picture("3-by-hand")
    x, y = splat_at(page, APPLE)
    page.drag("#scene", (x, y), (x, y + 0.02))
    page.until(f"splatlift.editor.selection.step === 1 && !splatlift.editor.isBusy && {FIND_COLOUR}")
    assert page.value("splatlift.query.current.count") > 20
    page.write("#hand .name", "lamp and a bit")  # rename it
    page.key("Enter")
    page.until("splatlift.objects.selections[0]?.name === 'lamp and a bit'")
    assert page.value(SAVE_OBJECTS).startswith("The file is saved.")  # export all with names
    page.press("#hand button[title='Ctrl+Z']")  # undo
    page.until(f"splatlift.editor.selection.step === 0 && !splatlift.editor.isBusy && {FIND_COLOUR}")
    object_id = page.value("splatlift.objects.selections[0].id")
    ask(page, "Lamp and a bit")  # find it by its name
    assert page.value("splatlift.query.current.sets") == [f"selection:{object_id}"]
    ask(page, "lamp")  # compare two words
    page.until("!document.querySelector('#by-hand').hidden")  # the answer is listed: nothing moves any more
    page.press("#panel-ask [data-compare]")
    page.until(BOTH_SETTLED)
    ask(page, "apple")
    save_picture("4-compared")
    link = page.value("location.href")  # share, and come back by the link
    page.open("about:blank#")
    page.open(link)
    page.until(f"{READY} && {BOTH_SETTLED} && splatlift.query.current?.answer")
    assert page.value("splatlift.query.current.text") == ["apple"] and "lamp" in text_of(page, "#beside-said")
    save_picture("5-link")
    page.press("#end-compare")
    (tmp_path / "again.ply").write_bytes(make_scene().splats)  # bring a scene
    page.drop([tmp_path / "again.ply"])
    page.until("document.querySelector('#sent .file.done')")
    save_picture("6-brought")
    page.press("#sent .file .away")
    assert server.client.delete(f"/lifts/{server.lift}/selections/{object_id}").status_code == 204
