"""Dispatch of requests to threads, and of their replies to the client.

| thread | does | why alone |
|---|---|---|
| reader (the caller of `handle`) | inputs, controls, cancelling | never waits |
| sessions | steps worlds in real time | session_loop.py |
| look | checks, pictures, recordings | milliseconds, must not wait for the others |
| make | mutates, generates, builds evaluation sets, writes .rrd files | compiles, or imports rerun, for seconds |
| open | opens sessions, loads policies | compiles for seconds |
| attempts | one evaluation at a time | seconds |
"""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from jax2d import palette
from kinetix_dist.checkpoint.store import pretrained_names
from kinetix_dist.errors import UserError, one_line
from kinetix_dist.level.generator_config import GENERATORS
from kinetix_dist.level.level import NUM_WALLS, SIZES
from kinetix_dist.level.mechanisms.ready_made import READY_MADE
from kinetix_dist.level.mutators import MUTATORS
from kinetix_dist.level.walls import WALL_CENTRES_M, WALL_HALF_EXTENTS_M, WALL_NAMES
from kinetix_dist.studio.worker import level_requests, play_requests
from kinetix_dist.studio.worker.level_requests import Answer
from kinetix_dist.studio.worker.programs import trim_heap
from kinetix_dist.studio.worker.request import Request
from kinetix_dist.studio.worker.session_loop import Running, SessionLoop
from kinetix_dist.studio.worker.wire import BAD_REQUEST, BUSY, FAILED, NOT_FOUND, Message, Outbox, RequestError

MAX_WAITING = 16  # requests, running ones counted
LOOK, MAKE, OPEN, ATTEMPTS = THREADS = ("look", "make", "open", "attempts")


class Service:
    """Dispatches messages of one client by the table above."""

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox
        self._loop = SessionLoop(outbox)
        self._threads = {name: ThreadPoolExecutor(max_workers=1, thread_name_prefix=name) for name in THREADS}
        self._lock = threading.Lock()
        self._requests: dict[int, Request] = {}
        self._handlers: dict[str, tuple[str, Callable[[Request], Answer]]] = {
            "check": (LOOK, level_requests.check),
            "display": (LOOK, level_requests.display),
            "document": (LOOK, level_requests.document),
            "thumbnails": (LOOK, level_requests.thumbnails),
            "evaluation_set": (MAKE, level_requests.evaluation_set),
            "documents": (MAKE, level_requests.documents),
            "recordings": (LOOK, level_requests.recordings),
            "recording": (LOOK, level_requests.recording),
            "rrd": (MAKE, level_requests.rrd),
            "convert": (LOOK, level_requests.convert),
            "mutate": (MAKE, level_requests.mutate_level),
            "generate": (MAKE, level_requests.generate),
            "mechanism": (MAKE, level_requests.mechanism),
            "attempts": (ATTEMPTS, play_requests.attempts),
        }

    @property
    def is_busy(self) -> bool:
        """True while a request is in work or a session runs."""
        with self._lock:
            return bool(self._requests) or self._loop.is_stepping

    @property
    def is_unused(self) -> bool:
        """True while nothing runs and no session is open."""
        return not self.is_busy and self._loop.num_sessions == 0

    def handle(self, message: Message) -> None:
        """Handles a message of the client, and replies now or later. Raises nothing that a client could cause."""
        fields = message.content
        kind = fields["type"]
        try:
            if kind == "play.input":
                self._input(fields)
            elif kind == "cancel":
                self._cancel(fields.get("id"))
            else:
                self._begin(fields)
        except RequestError as error:
            self._refuse(fields, error)

    def _input(self, fields: dict[str, Any]) -> None:
        def act(running: Running) -> None:
            try:
                running.session.set_input(fields.get("action"), fields.get("seq"))
            except RequestError as error:
                self._refuse(fields, error)

        self._loop.command(_session_of(fields), act)

    def _cancel(self, number: Any) -> None:
        with self._lock:
            request = self._requests.get(number) if type(number) is int else None
        if request is not None:
            request.cancel()

    def _begin(self, fields: dict[str, Any]) -> None:
        if type(fields.get("id")) is not int:
            raise RequestError(BAD_REQUEST, f"{fields['type']}: id is {fields.get('id')!r}; give a whole number")
        request = Request(fields, self._outbox)
        with self._lock:
            if request.id in self._requests:
                raise RequestError(BAD_REQUEST, f"id {request.id} is in use; number requests one after another")
            if len(self._requests) >= MAX_WAITING:
                raise RequestError(BUSY, f"{MAX_WAITING} requests wait already; try again when they are answered")
            self._requests[request.id] = request
        try:
            self._dispatch(request)
        except BaseException:
            self._end(request)
            raise

    def _dispatch(self, request: Request) -> None:
        kind = request.fields["type"]
        if kind in self._handlers:
            thread, handler = self._handlers[kind]
            waits = thread == LOOK and level_requests.is_of_set(request.fields)
            self._submit(MAKE if waits else thread, handler, request)
        elif kind == "play.open":
            self._submit(OPEN, self._open, request)
        elif kind in ("play.control", "play.close"):
            self._control(request)
        else:
            known = ", ".join([*self._handlers, "play.open", "play.input", "play.control", "play.close", "cancel"])
            raise RequestError(BAD_REQUEST, f"there is no request {kind[:40]!r}; there are {known}")

    def _submit(self, thread: str, handler: Callable[[Request], Answer | None], request: Request) -> None:
        def work() -> None:
            self._answer(request, lambda: handler(request))
            if thread != LOOK:
                trim_heap()

        self._threads[thread].submit(work)

    def _open(self, request: Request) -> None:
        is_running = request.flag("running", default=False)
        session, answer = play_requests.open_session(request, self._loop)
        self._outbox.send({"type": "reply", "id": request.id, **answer})
        self._loop.add(session)

        def begin(running: Running) -> None:
            self._loop.show(running)
            running.run(is_running)

        self._loop.command(session.number, begin)

    def _control(self, request: Request) -> None:
        number, after = _session_of(request.fields), None
        if request.fields["type"] == "play.close":

            def do(running: Running) -> dict[str, Any]:
                self._loop.close(running)
                return {}

        else:
            do, after = play_requests.control(request, self._loop, self._threads[OPEN])

        def command(running: Running) -> None:
            def answer() -> Answer:
                if running.is_closed:
                    raise RequestError(NOT_FOUND, f"there is no session {number} (any more)")
                return do(running), b""

            self._answer(request, answer)

        self._loop.command(number, command, after=after)

    def _answer(self, request: Request, work: Callable[[], Answer | None]) -> None:
        """Runs the work of a request and sends its result as the reply; None: the work has replied itself."""
        try:
            request.check_cancelled()
            answer = work()
            if answer is not None:
                content, body = answer
                self._outbox.send({"type": "reply", "id": request.id, **content}, body)
        except RequestError as error:
            self._refuse(request.fields, error)
        except UserError as error:
            self._refuse(request.fields, RequestError(BAD_REQUEST, one_line(error)))
        except Exception as error:  # a bug of ours: reported, logged, and the worker goes on
            traceback.print_exception(error)
            text = f"a bug in the worker: {type(error).__name__}: {one_line(error)[:200]}; its log has the traceback"
            self._refuse(request.fields, RequestError(FAILED, text))
        finally:
            self._end(request)

    def _end(self, request: Request) -> None:
        with self._lock:
            self._requests.pop(request.id, None)

    def _refuse(self, fields: dict[str, Any], error: RequestError) -> None:
        names = {name: fields[name] for name in ("id", "session") if type(fields.get(name)) is int}
        self._outbox.send({"type": "error", **names, "code": error.code, "text": one_line(error)})


def _session_of(fields: dict[str, Any]) -> int:
    number = fields.get("session")
    if type(number) is not int:
        raise RequestError(BAD_REQUEST, f"{fields['type']}: session is {number!r}; give the number of one that is open")
    return number


def hello() -> dict[str, Any]:
    """Fields of the first message: what may be requested, and colours and lengths (m) of pictures.

    Sizes count the entities that a level may have besides its walls.
    """
    kinds = ("polygons", "circles", "joints", "thrusters")
    sizes = {name: {kind: getattr(capacity, kind) for kind in kinds} for name, capacity in SIZES.items()}
    for counts in sizes.values():
        counts["polygons"] -= NUM_WALLS
    walls = zip(WALL_NAMES, WALL_CENTRES_M.tolist(), WALL_HALF_EXTENTS_M.tolist(), strict=True)
    return {
        "walls": [{"name": name, "position": at, "half_extents": half} for name, at, half in walls],
        "palette": palette.as_json(),
        "sizes": sizes,
        "generators": list(GENERATORS),
        "mutators": list(MUTATORS),
        "mechanisms": [{"name": name, "help": one.help} for name, one in READY_MADE.items()],
        "pretrained": pretrained_names(),
    }
