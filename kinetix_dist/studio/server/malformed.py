"""Requests that are malformed: answered 400, one line, before any page handles them.

aiohttp reads the bytes of headers that are not UTF-8 as surrogates, which no text can be encoded with again. It leaves
it to pages to parse `Host` and `Origin`, and decodes bodies by the charset that they claim.
"""

from __future__ import annotations

import logging
from typing import Any
from urllib.parse import urlsplit

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from kinetix_dist.errors import one_line
from kinetix_dist.studio.server.access import Handler
from kinetix_dist.studio.server.responses import BadRequestError, error_response
from kinetix_dist.text_files import decode_text, loads_json


@web.middleware
async def refuse_malformed(request: web.Request, handler: Handler) -> web.StreamResponse:
    """Middleware, the outermost: handlers get headers and paths that can be parsed, encoded and looked up."""
    problems = [_header_problem(name.lower(), value) for name, value in request.headers.items()]
    if not request.path.isprintable():  # names of runs and files in addresses are (runs/address_names.py)
        problems.append("the path has characters that are not printable")
    for problem in filter(None, problems):
        return error_response(400, problem)
    return await handler(request)


def _header_problem(name: str, value: str) -> str | None:
    encoding = "ASCII" if name.startswith("sec-websocket-") else "UTF-8"
    try:
        f"{name}{value}".encode(encoding)
        if name in ("host", "origin"):
            _ = urlsplit(value if name == "origin" else f"//{value}").port
    except UnicodeEncodeError:
        return f"the header {name} is not {encoding}"
    except ValueError as error:
        return f"the header {name} is malformed ({one_line(error)})"
    return None


async def body_text(request: web.Request) -> str:
    """Return the text of a body, UTF-8 whatever charset it claims. Raises BadRequestError."""
    try:
        return decode_text(await request.read())
    except UnicodeDecodeError as error:
        raise BadRequestError(f"the body is not UTF-8 ({error.reason} at byte {error.start})") from error
    except (web.RequestPayloadError, ConnectionResetError) as error:  # a wrong encoding; the sender is gone
        raise BadRequestError(f"the body cannot be read ({one_line(error)})") from error


def json_object(text: str, name: str) -> dict[str, Any]:
    """Return the JSON object of a text. Raises BadRequestError, which begins with the name."""
    try:
        content = loads_json(text)
    except ValueError as error:
        raise BadRequestError(f"{name} is not JSON ({error})") from error
    if not isinstance(content, dict):
        raise BadRequestError(f"{name} is no JSON object")
    return content


def quiet_malformed(record: logging.LogRecord) -> bool:
    """Filter of aiohttp's log: a request that is not HTTP gets the reason, and the console no traceback."""
    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, (HttpProcessingError, web.RequestPayloadError))
