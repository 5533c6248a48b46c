"""Answers of the server: JSON, compressed where that pays, and one line for what was wrong."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from aiohttp import web

COMPRESS_FROM_BYTES = 1024


class BadRequestError(ValueError):
    """What was asked for makes no sense: one line says why."""


def json_response(content: Any, *, status: int = 200) -> web.Response:
    """nan is no JSON: raises ValueError, and is a mistake of ours."""
    body = json.dumps(content, allow_nan=False, separators=(",", ":")).encode()
    response = web.Response(body=body, status=status, content_type="application/json", charset="utf-8")
    if len(body) >= COMPRESS_FROM_BYTES:
        response.enable_compression()
    return response


def error_response(status: int, text: str) -> web.Response:
    """{"error": one line}"""
    return json_response({"error": " ".join(text.split())}, status=status)


def number(
    query: Mapping[str, str],
    name: str,
    default: float | None = None,
    *,
    low: float = -math.inf,
    high: float = math.inf,
) -> Any:
    """A number of a query; raises BadRequestError for anything else, and outside of its range."""
    text = query.get(name, "")
    if text == "":
        return default
    try:
        value = float(text)
    except ValueError:
        raise BadRequestError(f"{name} is {text!r}; it must be a number") from None
    if not math.isfinite(value) or not low <= value <= high:
        raise BadRequestError(f"{name} is {text}; it must be between {low:g} and {high:g}")
    return value
