"""Progress bars of the library."""

import io
from typing import Any

import pytest

import liftcore as lc
from tests.scenes import observed, random_camera, random_splats


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def lifted(**options: Any) -> lc.LiftResult:
    views = {f"v{k}": observed(1, k) for k in range(2)}
    cameras = {name: random_camera(k, name=name) for k, name in enumerate(views)}
    return lc.lift(random_splats(1), cameras, views, preset="row-sum", **options)


def test_bars_are_drawn_on_a_terminal_alone_and_not_where_they_are_declined(monkeypatch: pytest.MonkeyPatch) -> None:
    output = {}
    for name, stderr, options in (
        ("terminal", Terminal(), {}),
        ("declined", Terminal(), {"progress": False}),
        ("file", io.StringIO(), {}),
        ("asked for", Terminal(), {"progress": True}),
    ):
        monkeypatch.setattr("sys.stderr", stderr)
        lifted(**options)
        output[name] = stderr.getvalue()
    assert "geometry: 100%" in output["terminal"] and "2/2" in output["terminal"]
    assert "geometry: 100%" in output["asked for"]
    assert output["declined"] == output["file"] == ""
    monkeypatch.setattr("sys.stderr", None)  # as under pythonw
    lifted()
