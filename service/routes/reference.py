"""The routes described for people: Swagger UI, whose files are shipped, as a robot's network may lead nowhere."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from fastapi import APIRouter, Response
from fastapi.openapi.docs import get_swagger_ui_html
from fastapi.responses import HTMLResponse

SHIPPED = Path(str(files("fastapi_offline"))) / "static"
NO_PICTURE = "data:,"  # the page asks another host for one unless it is told

router = APIRouter(include_in_schema=False)


@router.get("/docs", response_class=HTMLResponse)
def docs() -> HTMLResponse:
    """The page. Its addresses are relative, so it works behind a proxy's prefix, too."""
    return get_swagger_ui_html(
        openapi_url="openapi.json",
        title="splatlift: routes",
        swagger_js_url="docs/swagger-ui-bundle.js",
        swagger_css_url="docs/swagger-ui.css",
        swagger_favicon_url=NO_PICTURE,
    )


@router.get("/docs/swagger-ui-bundle.js")
def script() -> Response:
    """What draws the page."""
    return Response((SHIPPED / "swagger-ui-bundle.js").read_bytes(), media_type="text/javascript")


@router.get("/docs/swagger-ui.css")
def style() -> Response:
    """How the page looks."""
    return Response((SHIPPED / "swagger-ui.css").read_bytes(), media_type="text/css")
