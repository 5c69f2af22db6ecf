"""The page in the Chromium of the system, driven by playwright."""

from __future__ import annotations

import contextlib
import json
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser as Chromium
from playwright.sync_api import BrowserContext, BrowserType, ConsoleMessage, Error, Page

PATIENCE_SECONDS = 300.0  # for what takes a second; the machine may be busy


def launch(kind: BrowserType, *options: str) -> Chromium:
    """Return a headless Chromium without a GPU; skip the test if this machine has none."""
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if program is None:
        pytest.skip("no Chromium on this machine (apt-get install chromium)")
    return kind.launch(executable_path=program, args=["--enable-unsafe-swiftshader", "--disable-gpu", *options])


@contextlib.contextmanager
def profile(chromium: Chromium) -> Iterator[BrowserContext]:
    """Yield a profile of the browser; its windows share the cache of files, and compile the page's libraries once."""
    with chromium.new_context(reduced_motion="reduce", color_scheme="dark") as context:
        yield context


class Browser:
    """One window without a history, and what its page asked for and complained about.

    ``faults`` has uncaught errors, those of the console, and what the policy of the page's contents refused;
    ``requests`` the addresses of all requests.
    """

    def __init__(self, page: Page) -> None:
        self.page = page
        self.faults: list[str] = []
        self.requests: list[str] = []
        # Scripts run by the protocol itself: playwright's `evaluate` needs an `eval` that the page's policy refuses.
        self._devtools = page.context.new_cdp_session(page)
        page.set_default_timeout(1000 * PATIENCE_SECONDS)
        page.on("pageerror", lambda error: self.faults.append(str(error)))
        page.on("console", self._note)
        page.on("request", lambda request: self.requests.append(request.url))

    @classmethod
    @contextlib.contextmanager
    def open_window(cls, context: BrowserContext) -> Iterator[Self]:
        """Yield a new window; afterwards it must have been silent, and have asked this machine alone."""
        with context.new_page() as page:
            browser = cls(page)
            yield browser
            assert browser.faults == []
            assert all(url.startswith(("http://127.0.0.1:", "blob:", "data:")) for url in browser.requests)

    def _note(self, message: ConsoleMessage) -> None:
        if message.type == "error" and not message.text.startswith("Failed to load resource"):
            self.faults.append(message.text)

    def open(self, address: str) -> None:
        """Go to an address, and wait until the document is there."""
        self.page.goto(address)

    def value(self, script: str) -> Any:
        """Return the value of an expression, or of its promise."""
        request = {"expression": script, "awaitPromise": True, "returnByValue": True}
        result = self._devtools.send("Runtime.evaluate", request)
        assert "exceptionDetails" not in result, f"{script}: {result['exceptionDetails']}"
        return result["result"].get("value")

    def until(self, script: str, seconds: float = PATIENCE_SECONDS) -> None:
        """Wait until an expression is true."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            with contextlib.suppress(AssertionError, Error):  # while one document makes room for the next
                if self.value(f"Promise.resolve({script}).then(Boolean)"):
                    return
            self.page.wait_for_timeout(50)
        raise AssertionError(f"never true: {script}; the page: {self.value('document.body.innerText')}")

    def press(self, selector: str, x: float = 0.5, y: float = 0.5, *, shift: bool = False, alt: bool = False) -> None:
        """Click an element, x and y as shares of its box."""
        self.drag(selector, (x, y), shift=shift, alt=alt)

    def drag(self, selector: str, *points: tuple[float, float], shift: bool = False, alt: bool = False) -> None:
        """Press the mouse at the first point, shares of an element's box, and release it at the last."""
        mouse, modifiers = self.page.mouse, ["Shift"] * shift + ["Alt"] * alt
        self.value(f"document.querySelector({json.dumps(selector)}).scrollIntoView({{block: 'nearest'}})")
        box = self.value(f"document.querySelector({json.dumps(selector)}).getBoundingClientRect().toJSON()")
        for modifier in modifiers:
            self.page.keyboard.down(modifier)
        for number, (x, y) in enumerate(points):
            mouse.move(box["left"] + x * box["width"], box["top"] + y * box["height"])
            if number == 0:
                mouse.down()
        mouse.up()
        for modifier in modifiers:
            self.page.keyboard.up(modifier)

    def key(self, name: str, *, shift: bool = False, ctrl: bool = False) -> None:
        """Press a key and release it."""
        self.page.keyboard.press("+".join(["Control"] * ctrl + ["Shift"] * shift + [name]))

    def write(self, selector: str, text: str) -> None:
        """Put text into a field, in place of what is there."""
        self.value(f"document.querySelector({json.dumps(selector)}).select()")
        self.page.keyboard.insert_text(text)

    def window(self, width: int, height: int, scheme: str = "dark") -> None:
        """Set the window's size in CSS pixels, and the colour scheme of its user, ``dark`` or ``light``."""
        self.page.set_viewport_size({"width": width, "height": height})
        self.page.emulate_media(color_scheme="light" if scheme == "light" else "dark")

    def choose_files(self, selector: str, files: list[Path]) -> None:
        """Choose files in an input for them."""
        self.page.set_input_files(selector, files)

    def drop(self, files: list[Path]) -> None:
        """Drag files and folders of this machine to the middle of the window."""
        centre = self.value("({x: innerWidth / 2, y: innerHeight / 2})")
        data = {"items": [], "files": [str(file) for file in files], "dragOperationsMask": 1}
        for kind in ("dragEnter", "dragOver", "drop"):
            self._devtools.send("Input.dispatchDragEvent", {"type": kind, "data": data, **centre})

    def violations(self) -> dict[str, list[str]]:
        """Return the violations on the page that axe does not call minor: elements by rule."""
        if not self.value("Boolean(globalThis.axe)"):
            self.value(Axe().axe_script)
        options = "{resultTypes: ['violations'], preload: false}"  # all styles are the page's own
        violations = self.value(f"axe.run(document, {options}).then(all => all.violations)")
        return {
            rule["id"]: [node["html"] for node in rule["nodes"]] for rule in violations if rule["impact"] != "minor"
        }
