"""HTTP API of teaching (teaching.py): the page requests a job, and asks how far it is.

GET    api/teaching     {results, seconds, job: {...} or null}
POST   api/teaching     {kind: "teach" or "solve", document, seconds} begins a job; 409 while another one runs
DELETE api/teaching     cancels the job
"""

from __future__ import annotations

from typing import Any

from aiohttp import web

from kinetix_dist.studio.server.malformed import body_text, json_object
from kinetix_dist.studio.server.responses import BadRequestError, error_response, json_response
from kinetix_dist.studio.server.teaching import SECONDS, BusyError, Teaching, TeachingError


class TeachingPages:
    """Handlers of `api/teaching`."""

    def __init__(self, teaching: Teaching) -> None:
        self._teaching = teaching

    def routes(self) -> list[web.RouteDef]:
        return [
            web.get("/api/teaching", self.show),
            web.post("/api/teaching", self.begin),
            web.delete("/api/teaching", self.cancel),
        ]

    async def show(self, request: web.Request) -> web.Response:
        return self._answer()

    async def begin(self, request: web.Request) -> web.Response:
        job = json_object(await body_text(request), "the request")
        try:
            kind, document, seconds = str(job["kind"]), job["document"], job["seconds"]
        except KeyError as error:
            raise BadRequestError("give kind, document and seconds as a JSON object") from error
        if not isinstance(document, dict):
            raise BadRequestError("document is no JSON object")
        try:
            await self._teaching.begin(kind, document, seconds)
        except BusyError as error:
            return error_response(409, str(error))
        except TeachingError as error:
            return error_response(422, str(error))
        except OSError as error:
            return error_response(
                507, f"{error.filename or self._teaching.results}: {error.strerror}; nothing was begun"
            )
        return self._answer()

    async def cancel(self, request: web.Request) -> web.Response:
        await self._teaching.cancel()
        return self._answer()

    def _answer(self) -> web.Response:
        job = self._teaching.job
        content: dict[str, Any] = {
            "results": str(self._teaching.results.resolve()),
            "seconds": SECONDS,
            "job": None if job is None else job.as_json(),
        }
        return json_response(content)
