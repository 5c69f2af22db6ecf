"""Files dropped on the page: inputs that are planned, compared and lifted, lift files and photos; names of lifts.

And tasks of a new user: open the example, find objects, correct, name and export them, compare two words, and open
the same state by a link.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
import zstandard
from PIL import Image

from liftcore.io.cameras import read_cameras
from liftcore.io.splats import read_splats
from service.routes import operations
from tests.inria_file import write_inria_cameras
from tests.promises.over_http import lift_of, upload_scene
from tests.promises.tiny_files import write_files
from tests.tiny_scene import DISTANCE, colmap_zip, make_scene

from .browser import PATIENCE_SECONDS, Browser
from .conftest import PageServer, serving
from .looking import AMBER, BOTH_SETTLED, FIND_COLOUR, READY, ask, columns, splat_at, text_of

pytestmark = pytest.mark.slow
SOG_FILE = Path(__file__).parents[1] / "data" / "splats" / "degree1.sog"
OPEN = "globalThis.splatlift && !document.querySelector('#panel-bring').hidden"
APPLE = 5  # a splat of it
SAVE_OBJECTS = "splatlift.exporter.saveLabels(true).then(() => document.querySelector('#toast').textContent)"
LONG = 1200.0  # seconds, for what runs a job on a busy machine, kernels and all


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    return write_files(tmp_path)


@pytest.fixture(scope="module")
def empty_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a service with a small example and no lift; all tests but the last delete theirs."""
    folder, scene = tmp_path_factory.mktemp("empty"), make_scene()
    (folder / "point_cloud.spz").write_bytes(scene.splats)
    (folder / "cameras.json").write_bytes(scene.cameras)
    (folder / "features.safetensors.zst").write_bytes(zstandard.compress(scene.features))
    with (
        pytest.MonkeyPatch.context() as patch,
        serving(folder / "data", encoder=f"table:{write_files(folder)['table']}") as address,
    ):
        patch.setattr(operations, "EXAMPLE", folder)
        yield address


@pytest.fixture
def empty(browser: Browser, empty_service: str) -> Iterator[Browser]:
    """Its page."""
    browser.window(1200, 800)
    browser.open(empty_service)
    browser.until(OPEN)
    yield browser
    browser.open("about:blank")


def test_lift_file_asks_for_what_it_was_made_of_and_opens(
    empty: Browser, empty_service: str, server: PageServer, files: dict[str, Path], tmp_path: Path
) -> None:
    (tmp_path / "brought.safetensors").write_bytes(server.client.get(f"/lifts/{server.lift}/features").content)
    empty.drop([tmp_path / "brought.safetensors"])
    empty.until("document.querySelector('.file.bad .state')?.textContent.includes('This lift needs its splats')")
    empty.drop([files["splats"], files["cameras"]])
    empty.until(READY)
    ask(empty, "lamp")
    assert min(columns(empty, AMBER)) > 50
    lift = empty.value("splatlift.lift.id")
    deletion = httpx.delete(f"{empty_service}/jobs/{lift}?with_lift=true", timeout=PATIENCE_SECONDS)
    assert deletion.status_code == 204


def test_dropped_files_become_an_object_that_lights_up(empty: Browser, files: dict[str, Path]) -> None:
    """The whole way: files are planned, compared and lifted, a phrase lights up the object, and all is deleted."""
    empty.drop([files[kind] for kind in ("splats", "cameras", "features")])
    empty.until("document.querySelector('#plan').textContent.includes('60 splats')")
    assert empty.value("fetch('jobs').then(reply => reply.json()).then(({jobs}) => jobs.length)") == 0
    empty.write("#budget", "10")
    empty.press("#compare")
    empty.until("document.querySelectorAll('#jobs .job').length === 1")
    double = "(button => { button.click(); button.click(); })(document.querySelector('#lift-it'))"
    empty.value(double)  # one job, which waits behind the comparison
    empty.until("document.querySelectorAll('#jobs .job').length === 2")
    empty.press("#jobs .job:first-child .actions button")
    empty.until("document.querySelector('#jobs .job:first-child').dataset.state === 'canceled'")
    empty.until("document.querySelector('#jobs .job:last-child').dataset.state === 'succeeded'", LONG)
    empty.until("splatlift.uploads.followedJobs.size === 0")  # the list is as it stays
    assert empty.value("fetch('jobs').then(reply => reply.json()).then(({jobs}) => jobs.length)") == 2
    empty.press("#jobs .job:last-child .actions button")
    empty.until("document.querySelector('#chart').open && document.querySelector('#chart img').naturalWidth")
    assert empty.violations() == {}
    settings = empty.value("[...splatlift.uploads.chart.tradeoff.runs].sort((a, b) => a.cpu_s - b.cpu_s)[0].settings")
    empty.press("#chart-runs button")  # its lift, which is made anew
    empty.until(READY, LONG)
    lift_settings = empty.value("splatlift.lift.settings")
    assert all(lift_settings[name] == settings[name] for name in ("preset", "quality"))
    ask(empty, "lamp")
    assert min(columns(empty, AMBER)) > 50
    low, high = empty.value("(({low, high}) => [low, high])(splatlift.query.current.objects[0].box)")
    assert low[0] < 1.2 < high[0] and low[2] < -DISTANCE < high[2]  # where the lamp stands
    empty.press("#tab-bring")
    empty.until("document.querySelector('#jobs .succeeded')")
    empty.value("splatlift.uploads.refresh()")
    empty.press("#jobs button.danger")  # and away with it
    empty.press("#jobs button.danger")
    empty.until("!document.querySelector('#empty').hidden")


def test_dropped_folder_brings_its_cameras(empty: Browser, tmp_path: Path) -> None:
    model = tmp_path / "model"
    with zipfile.ZipFile(io.BytesIO(colmap_zip())) as archive:
        archive.extractall(model)
    (model / "sparse" / "0" / "notes.md").write_text("not a camera")
    (model / "point_cloud.ply").write_bytes(make_scene().splats)
    empty.drop([model])
    empty.until("document.querySelectorAll('.file.done').length === 2")
    names = empty.value("[...document.querySelectorAll('.file.done .name')].map(name => name.textContent)")
    assert sorted(names) == ["model.zip", "point_cloud.ply"] and "3 views" in text_of(empty, "#sent")


def test_folder_of_a_sog_and_cameras_is_sent_as_two_files(
    empty: Browser, files: dict[str, Path], tmp_path: Path
) -> None:
    with zipfile.ZipFile(SOG_FILE) as archive:
        archive.extractall(tmp_path / "my garden" / "splats")
    write_inria_cameras(read_cameras(files["cameras"]), tmp_path / "my garden" / "cameras.json")
    empty.drop([tmp_path / "my garden"])
    empty.until("document.querySelectorAll('.file.done').length === 2")
    file_names = "[...document.querySelectorAll('.file.done .name')].map(name => name.textContent).sort()"
    assert empty.value(file_names) == ["cameras.json", "my garden.sog"]
    assert f"{read_splats(SOG_FILE).count} splats" in text_of(empty, "#sent")


def test_wrong_file_is_named_and_leaves_the_good_one(empty: Browser, files: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "broken.ply").write_bytes(files["splats"].read_bytes()[:-40])
    empty.choose_files("#files", [tmp_path / "broken.ply", files["cameras"]])
    empty.until("document.querySelector('.file.bad')")
    assert "broken.ply" in text_of(empty, ".file.bad .name")
    assert "expected" in text_of(empty, ".file.bad .state") and "got" in text_of(empty, ".file.bad .state")
    assert empty.value("document.querySelector('#lift-it').disabled") is True
    empty.press(".file.bad .away")
    empty.drop([files["splats"]])
    empty.until("document.querySelectorAll('.file.done').length === 2 && !document.querySelector('.file.bad')")
    empty.press(".file.done .actions button")  # it is shown before it is lifted
    empty.until("splatlift.viewer?.draft && splatlift.viewer.count === 60")


def test_scenes_that_others_make_and_delete_are_followed(empty: Browser) -> None:
    with httpx.Client(base_url=empty.value("location.origin"), timeout=PATIENCE_SECONDS) as other:
        job = lift_of(other, upload_scene(other, make_scene()))["id"]
        empty.press("#tab-bring")
        empty.until(READY, LONG)  # nothing was open, so it is
        assert empty.value("splatlift.lift.id") == job
        assert other.delete(f"/jobs/{job}?with_lift=true").status_code == 204
        empty.press("#tab-bring")
        empty.until("!document.querySelector('#empty').hidden && !splatlift.lift")


def test_lift_takes_a_name_and_photos(browser: Browser, server: PageServer, tmp_path: Path) -> None:
    browser.window(1200, 800)
    browser.open(server.address)
    browser.until(READY)
    browser.press("#name-lift")
    browser.write("#lift-name", "Fruit and light")
    browser.key("Enter")
    browser.until("document.querySelector('#lift').selectedOptions[0].text === 'Fruit and light'")
    content = io.BytesIO()
    Image.new("RGB", (32, 24), (200, 40, 200)).save(content, "PNG")
    (tmp_path / "left.png").write_bytes(content.getvalue())
    browser.drop([tmp_path / "left.png"])
    browser.until("document.querySelector('.file .actions button')")
    browser.press(".file .actions button")
    browser.until("splatlift.lift.photos")
    browser.until(READY)
    browser.press("#tools input[value=view] + span")
    browser.press("#tab-look")
    browser.press("#layer-photo")
    browser.until("document.querySelector('#over').naturalWidth === 32")
    browser.press("#view-after")
    browser.until("document.querySelector('#layer-words').textContent === 'This view has no photo.'")
    assert browser.value("document.querySelector('#over').hidden") is True


# Tasks


def check_layout(page: Browser, step: str) -> None:
    """Require a page that is no wider than its window, and without violations."""
    assert page.value("document.documentElement.scrollWidth <= innerWidth"), step
    assert page.violations() == {}, step


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (390, 844)])
def test_ten_tasks_are_done_without_a_manual(
    browser: Browser, server: PageServer, empty_service: str, tmp_path: Path, width: int, height: int
) -> None:
    page = browser
    page.window(width, height)
    page.open(empty_service)  # open the example
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


def test_example_opens_by_its_button(browser: Browser, empty_service: str) -> None:
    browser.window(1440, 900)
    browser.open(empty_service)
    browser.until("!document.querySelector('#empty').hidden")
    browser.press("#open-example")
    browser.until(READY)
    ask(browser, "lamp")
    assert len(columns(browser, AMBER)) > 50
    check_layout(browser, "example")
