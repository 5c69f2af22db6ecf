"""How /openapi.json tells of keys: as things are now, with or without them."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI

from service.keys.scopes import Scope, needed
from service.store.keys import KeyStore

SCHEMES = {
    "key": {
        "type": "http",
        "scheme": "bearer",
        "description": f"A key that the operator made, with one or more of the scopes {', '.join(Scope)}.",
    }
}


def describe_keys(app: FastAPI, keys: KeyStore) -> None:
    """Let the application's OpenAPI document say which operations need a key, as soon as any does."""
    plain = app.openapi

    def openapi() -> dict[str, Any]:
        document = plain()
        if not keys.required():
            return document
        paths = {
            path: {method: _secured(method, path, operation) for method, operation in operations.items()}
            for path, operations in document["paths"].items()
        }
        return {**document, "paths": paths, "components": {**document["components"], "securitySchemes": SCHEMES}}

    app.openapi = openapi


def _secured(method: str, path: str, operation: dict[str, Any]) -> dict[str, Any]:
    scope = needed(method.upper(), path)
    return operation if scope is None else {**operation, "security": [{"key": [scope]}]}
