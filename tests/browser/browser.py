"""Headless Chromium, controlled over two pipes by the DevTools protocol, without a driver."""

from __future__ import annotations

import contextlib
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

NAMES = ("chromium", "chromium-browser", "google-chrome")
PATIENCE_SECONDS = 60.0  # for what takes a second; the machine may be busy
AXE = (Path(__file__).parent / "axe.min.js").read_text(encoding="utf-8")
OPTIONS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--disable-dev-shm-usage",
    "--enable-unsafe-swiftshader", "--force-prefers-reduced-motion", "--hide-scrollbars",
    "--window-size=900,700", "--remote-debugging-pipe",
)  # fmt: skip
ALT, CTRL, SHIFT = 1, 2, 8  # DevTools' bits of the keys
KEYS = {"Enter": 13, "Escape": 27, "Tab": 9, "ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40}


def chromium() -> str | None:
    """The browser's program, if this machine has one."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Browser:
    """One window.

    ``faults`` keeps what its scripts say of errors: uncaught ones, those of the console, and what the policy of the
    page's contents refused; ``requests`` the addresses of all its requests.
    """

    def __init__(self, process: subprocess.Popen[bytes], writer: int, reader: int) -> None:
        self._process, self._writer, self._reader = process, writer, reader
        self._buffer, self._last, self._session = b"", 0, ""
        self.faults: list[str] = []
        self.requests: list[str] = []

    @classmethod
    @contextlib.contextmanager
    def launch(cls, program: str, profile: Path, *options: str) -> Iterator[Self]:
        """A browser with an empty profile and ``options`` options; gone at the end."""
        (theirs_in, writer), (reader, theirs_out) = os.pipe(), os.pipe()
        # Chromium looks for its pipes at 3 and 4, where this process has other things.
        redirect = f'exec "$@" 3<&{theirs_in} 4>&{theirs_out}'
        command = [
            "bash",
            "-c",
            redirect,
            "bash",
            program,
            *OPTIONS,
            *options,
            f"--user-data-dir={profile}",
            "about:blank",
        ]
        quiet = subprocess.DEVNULL
        process = subprocess.Popen(command, stdout=quiet, stderr=quiet, pass_fds=(theirs_in, theirs_out))
        os.close(theirs_in)
        os.close(theirs_out)
        try:
            browser = cls(process, writer, reader)
            browser._attach()
            yield browser
        finally:
            process.kill()
            process.wait()
            os.close(writer)
            os.close(reader)

    def _attach(self) -> None:
        pages = [info for info in self._call("Target.getTargets")["targetInfos"] if info["type"] == "page"]
        attached = self._call("Target.attachToTarget", targetId=pages[0]["targetId"], flatten=True)
        self._session = attached["sessionId"]
        self._call("Page.enable")
        self._call("Runtime.enable")
        self._call("Network.enable")
        self._call("Log.enable")

    def open(self, address: str) -> None:
        """Go to an address, and wait until the document is there."""
        self._call("Page.navigate", url=address)
        self.until("document.readyState === 'complete' && location.href !== 'about:blank'")

    def value(self, script: str) -> Any:
        """Return the value of an expression, or of its promise."""
        result = self._call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in result:
            raise AssertionError(f"{script}: {result['exceptionDetails']}")
        return result["result"].get("value")

    def until(self, script: str, seconds: float = PATIENCE_SECONDS) -> None:
        """Wait until an expression is true."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            with contextlib.suppress(AssertionError):  # while one document makes room for the next
                if self.value(f"Promise.resolve({script}).then(Boolean)"):
                    return
            time.sleep(0.05)
        raise AssertionError(f"never true: {script}; the page: {self.value('document.body.innerText')}")

    def press(self, selector: str, x: float = 0.5, y: float = 0.5, *, shift: bool = False, alt: bool = False) -> None:
        """Click an element, x and y as shares of its box."""
        self.drag(selector, (x, y), shift=shift, alt=alt)

    def drag(self, selector: str, *places: tuple[float, float], shift: bool = False, alt: bool = False) -> None:
        """Press the mouse at the first place, shares of an element's box, and let it go at the last."""
        self.value(f"document.querySelector({json.dumps(selector)}).scrollIntoView({{block: 'nearest'}})")
        box = self.value(f"document.querySelector({json.dumps(selector)}).getBoundingClientRect().toJSON()")
        points = [{"x": box["left"] + x * box["width"], "y": box["top"] + y * box["height"]} for x, y in places]
        moves = [("mouseMoved", point) for point in points[1:]]
        for kind, point in (("mousePressed", points[0]), *moves, ("mouseReleased", points[-1])):
            mouse = {"button": "left", "buttons": 1, "clickCount": 1, "modifiers": SHIFT * shift + ALT * alt}
            self._call("Input.dispatchMouseEvent", type=kind, **mouse, **point)

    def forget_history(self) -> None:
        """Take away what Back leads to: Chromium keeps 50 entries, and then counts no further."""
        self._call("Page.resetNavigationHistory")

    def key(self, name: str, *, shift: bool = False, ctrl: bool = False) -> None:
        """Press a key and let it go."""
        event = {
            "key": name,
            "modifiers": SHIFT * shift + CTRL * ctrl,
            "windowsVirtualKeyCode": KEYS.get(name, ord(name[0].upper())),
        }
        text = {"text": "\r" if name == "Enter" else name} if name == "Enter" or (len(name) == 1 and not ctrl) else {}
        self._call("Input.dispatchKeyEvent", type="keyDown" if text else "rawKeyDown", **event, **text)
        self._call("Input.dispatchKeyEvent", type="keyUp", **event)

    def window(self, width: int, height: int, scheme: str = "dark", zoom: int = 1) -> None:
        """The window's size in CSS pixels, whether its user likes it ``dark`` or ``light``, and device pixels a CSS
        pixel: who zooms in has more of these, in a smaller window."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
        size["deviceScaleFactor"] = zoom
        self._call("Emulation.setDeviceMetricsOverride", **size)
        self._call("Emulation.setEmulatedMedia", features=[
            {"name": "prefers-color-scheme", "value": scheme}, {"name": "prefers-reduced-motion", "value": "reduce"},
        ])  # fmt: skip

    def violations(self) -> dict[str, list[str]]:
        """Return the violations on the page that axe does not call minor: elements by rule."""
        self.value(f"(() => {{ {AXE}; }})()")
        problems = self.value("axe.run(document).then(all => all.violations)")
        return {
            rule["id"]: [node["html"] for node in rule["nodes"]] for rule in problems if rule["impact"] != "minor"
        }

    def screenshot(self) -> str:
        """The window as a PNG, in base64."""
        return self._call("Page.captureScreenshot", format="png")["data"]

    def give(self, selector: str, files: list[Path]) -> None:
        """Choose files in an input for them."""
        node = self._call("DOM.getDocument")["root"]["nodeId"]
        node_id = self._call("DOM.querySelector", nodeId=node, selector=selector)["nodeId"]
        self._call("DOM.setFileInputFiles", nodeId=node_id, files=[str(file) for file in files])

    def drop(self, files: list[Path]) -> None:
        """Drag files of this machine over the middle of the window, and let them go there."""
        size = self.value("({x: innerWidth / 2, y: innerHeight / 2})")
        data = {"items": [], "files": [str(file) for file in files], "dragOperationsMask": 1}
        for kind in ("dragEnter", "dragOver", "drop"):
            self._call("Input.dispatchDragEvent", type=kind, data=data, **size)

    def write(self, selector: str, text: str) -> None:
        """Put text into a field, in place of what is there."""
        self.value(f"document.querySelector({json.dumps(selector)}).select()")
        self._call("Input.insertText", text=text)

    def _call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._last += 1
        message: dict[str, Any] = {"id": self._last, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._writer, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            self._note(answer.get("method"), answer.get("params", {}))
            if answer.get("id") == self._last:
                if "error" in answer:
                    raise AssertionError(f"{method}: {answer['error']}")
                return answer["result"]

    def _note(self, method: str | None, params: dict[str, Any]) -> None:
        if method == "Runtime.exceptionThrown":
            self.faults.append(str(params["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled" and params["type"] == "error":
            self.faults.append(str(params["args"]))
        elif (
            method == "Log.entryAdded"
            and params["entry"]["level"] == "error"
            and params["entry"]["source"] != "network"
        ):
            self.faults.append(params["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            if not select.select([self._reader], [], [], PATIENCE_SECONDS)[0]:
                raise AssertionError("the browser says nothing")
            block = os.read(self._reader, 1 << 16)
            if not block:
                raise AssertionError("the browser has gone")
            self._buffer += block
        message, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(message)
