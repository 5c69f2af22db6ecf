"""Tasks of a new user: open the example, find objects, correct, name and export them, compare two words, and open
the same state by a link.
"""

from __future__ import annotations

from collections.abc import Iterator
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


@pytest.fixture(scope="module")
def empty(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A service without a lift, which ships a small example; the test that opens the example comes last."""
    folder, scene = tmp_path_factory.mktemp("empty"), make_scene()
    example = folder / "example"
    example.mkdir()
    (example / "point_cloud.spz").write_bytes(scene.splats)
    (example / "cameras.json").write_bytes(scene.cameras)
    (example / "features.safetensors.zst").write_bytes(zstandard.compress(scene.features))
    (folder / "table.safetensors").write_bytes(scene.table)
    with (
        pytest.MonkeyPatch.context() as patch,
        serving(folder / "data", encoder=f"table:{folder}/table.safetensors") as address,
    ):
        patch.setattr(operations, "EXAMPLE", example)
        yield address


def check_layout(page: Browser, step: str) -> None:
    """Require a page that is no wider than its window, and without violations."""
    assert page.value("document.documentElement.scrollWidth <= innerWidth"), step
    assert page.violations() == {}, step


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (390, 844)])
def test_ten_tasks_are_done_without_a_manual(
    browser: Browser, server: PageServer, empty: str, tmp_path: Path, width: int, height: int
) -> None:
    page = browser
    page.window(width, height)
    page.open(empty)  # open the example
    page.until("!document.querySelector('#empty').hidden")
    check_layout(page, "empty")
    assert page.value("document.querySelector('#open-example').checkVisibility()") is True
    page.open(f"{server.address}/?lift={server.lift}")
    page.until(READY)
    for word in ("book", "apple", "lamp"):  # find three things
        ask(page, word)
        assert len(columns(page, AMBER)) > 50
    check_layout(page, "found")
    page.press("#by-hand")  # correct one
    page.until(f"splatlift.editor.selection?.version && {FIND_COLOUR}")
    check_layout(page, "by-hand")
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
    check_layout(page, "compared")
    link = page.value("location.href")  # share, and come back by the link
    page.open("about:blank#")
    page.open(link)
    page.until(f"{READY} && {BOTH_SETTLED} && splatlift.query.current?.answer")
    assert page.value("splatlift.query.current.text") == ["apple"] and "lamp" in text_of(page, "#beside-said")
    check_layout(page, "link")
    page.press("#end-compare")
    (tmp_path / "again.ply").write_bytes(make_scene().splats)  # bring a scene
    page.drop([tmp_path / "again.ply"])
    page.until("document.querySelector('#sent .file.done')")
    check_layout(page, "brought")
    page.press("#sent .file .away")
    assert server.client.delete(f"/lifts/{server.lift}/selections/{object_id}").status_code == 204


def test_example_opens_by_its_button(browser: Browser, empty: str) -> None:
    browser.window(1440, 900)
    browser.open(empty)
    browser.until("!document.querySelector('#empty').hidden")
    browser.press("#open-example")
    browser.until(READY)
    ask(browser, "lamp")
    assert len(columns(browser, AMBER)) > 50
    check_layout(browser, "example")
