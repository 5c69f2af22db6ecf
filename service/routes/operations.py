"""/healthz, and the page."""

from __future__ import annotations

from pathlib import Path

from fastapi import APIRouter
from fastapi.responses import HTMLResponse

from service import wire

PAGE = Path(__file__).parents[1] / "web" / "index.html"

router = APIRouter(tags=["operations"])


# Async, and with nothing to wait for: a sync route would queue behind every slow one in the thread pool.
@router.get("/healthz", response_model=wire.Health)
async def healthz() -> wire.Health:
    """Whether the HTTP process answers."""
    return wire.Health(status="ok")


@router.get("/", response_class=HTMLResponse, include_in_schema=False)
def page() -> str:
    """The page."""
    return PAGE.read_text(encoding="utf-8")
