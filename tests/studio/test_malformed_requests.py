"""Requests that no browser sends, from raw sockets: status 400, one line, and no traceback in the console."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import Iterator
from pathlib import Path

import aiohttp
import pytest

from tests.helpers import PATIENCE_S
from tests.studio.runs_for_tests import write_run
from tests.studio.serving import Server, end, serving

GET, SAVE, TEACH = "GET /api/runs", "PUT /api/files/x.json", "POST /api/teaching"
NEW = b"If-None-Match: *"
WEBSOCKET = (b"Upgrade: websocket", b"Connection: Upgrade", b"Sec-WebSocket-Version: 13")

# name: (method and path, headers, body)
MALFORMED: dict[str, tuple[str, tuple[bytes, ...], bytes]] = {
    "host": (GET, (b"Host: \xff",), b""),
    "host of an address": (GET, (b"Host: [",), b""),
    "port": (GET, (b"Host: localhost:x",), b""),
    "origin": (GET, (b"Origin: http://[",), b""),
    "origin bytes": (GET, (b"Origin: http://\xff",), b""),
    "origin port": (GET, (b"Origin: http://localhost:99999",), b""),
    "cookie": (GET, (b"Cookie: \xff",), b""),
    "cookie value": (GET, (b"Cookie: %s=\xff",), b""),
    "accept": (GET, (b"Accept: \xff",), b""),
    "etag": ("GET /static/app.js", (b"If-None-Match: \xff",), b""),
    "query bytes": (f"{GET}?x=\xff", (), b""),
    "query": ("GET /api/runs/a/series?points=%ff", (), b""),
    "path bytes": ("GET /api/runs/\xff", (), b""),
    "path nul": ("GET /api/runs/a/recordings/%00.mcap/0", (), b""),
    "path escape": ("GET /api/runs/%1b%5b2J", (), b""),
    "path line": ("GET /static/a%0d%0ab", (), b""),
    "address": ("GET http://[", (), b""),
    "method": ("F\xff /api/runs", (), b""),
    "header name": (GET, (b"\xff: a",), b""),
    "length": (SAVE, (NEW, b"Content-Length: -1"), b"{}"),
    "length text": (SAVE, (NEW, b"Content-Length: two"), b"{}"),
    "length huge": (SAVE, (NEW, b"Content-Length: 99999999999999999999999"), b"{}"),
    "length twice": (SAVE, (NEW, b"Content-Length: 2", b"Content-Length: 3"), b"{}"),
    "chunk": (SAVE, (NEW, b"Transfer-Encoding: chunked"), b"zz\r\n{}\r\n0\r\n\r\n"),
    "gzip": (SAVE, (NEW, b"Content-Encoding: gzip"), b"{}"),
    "if-match": (SAVE, (b'If-Match: "\xff"',), b"{}"),
    "body": (SAVE, (NEW,), b"\xff"),
    "body charset": (SAVE, (NEW, b"Content-Type: text/plain; charset=utf-16"), b"\xff"),
    "body list": (SAVE, (NEW,), b"[]"),
    "body deep": (SAVE, (NEW,), b'{"a":' + b"[" * 100_000 + b"}"),
    "body nan": (SAVE, (NEW,), b'{"gravity": [NaN, 0]}'),
    "body infinity": (SAVE, (NEW,), b'{"gravity": [1e999, 0]}'),
    "body twice": (SAVE, (NEW,), b'{"name": "a", "name": "b"}'),
    "teach": (TEACH, (), b"\xff"),
    "teach charset": (TEACH, (b"Content-Type: text/plain; charset=none",), b"{}"),
    "teach list": (TEACH, (), b"[]"),
    "teach deep": (TEACH, (), b"[" * 100_000),
    "teach nan": (TEACH, (), b'{"kind": "teach", "document": {"gravity": [NaN, 0]}, "seconds": 60}'),
    "websocket": ("GET /channel", (*WEBSOCKET, b"Sec-WebSocket-Key: \xff"), b""),
    "websocket key": ("GET /channel", (*WEBSOCKET, "Sec-WebSocket-Key: é".encode()), b""),
}


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("malformed")
    write_run(directory / "runs" / "a")
    (directory / "levels").mkdir()
    return directory


@pytest.fixture(scope="module")
def server(directory: Path) -> Iterator[Server]:
    """The editor with a run, whose console must stay free of tracebacks."""
    results = ("--results", directory / "runs")
    with serving(directory / "levels", "--no-play", *results, name="edit") as server:
        yield server
        console = end(server.process)
        assert "Traceback" not in console and "Error" not in console, console


def answer_of(server: Server, line: str, headers: tuple[bytes, ...], body: bytes) -> tuple[int, bytes]:
    """Send the bytes of a request. Return status and body."""
    own = {b"host": b"Host: 127.0.0.1:%d" % server.port, b"cookie": b"Cookie: " + server.cookie.encode()}
    named = [header.replace(b"%s", server.cookie.split("=")[0].encode()) for header in headers]
    names = {header.split(b":")[0].lower() for header in named}
    named += [header for name, header in own.items() if name not in names]
    if body and not names & {b"content-length", b"transfer-encoding"}:
        named.append(b"Content-Length: %d" % len(body))
    with socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE_S) as connection:
        head = b"\r\n".join([line.encode("latin-1") + b" HTTP/1.1", *named, b"Connection: close"])
        connection.sendall(head + b"\r\n\r\n" + body)
        content = b""
        while part := connection.recv(1 << 16):
            content += part
    status, _, rest = content.partition(b"\r\n\r\n")
    return int(status.split()[1]), rest


@pytest.mark.parametrize("name", MALFORMED)
def test_a_malformed_request_is_answered_400(name: str, server: Server, directory: Path) -> None:
    status, content = answer_of(server, *MALFORMED[name])
    assert status == 400, content
    if content.startswith(b"{"):  # of a page; else of the parser of HTTP
        assert "\n" not in json.loads(content)["error"]
    assert not list((directory / "levels").iterdir())


def test_a_request_that_ends_early_is_no_bug(server: Server) -> None:
    with socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE_S) as connection:
        head = f"{SAVE} HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: {server.cookie}\r\nIf-None-Match: *\r\n"
        connection.sendall(f"{head}Content-Length: 10\r\n\r\n{{}}".encode())
    server.json("/api/runs")


@pytest.mark.parametrize(
    "message",
    [
        "[" * 100_000,
        '{"type": "watch", "run": "a", "since": 1e999}',
        '{"type": "watch", "run": "a", "since": NaN}',
        '{"type": "hello", "type": "hello", "version": 1}',
        '{"type": "\\ud800"}',
        json.dumps({"type": "x" * 1_000_000}),
        '{"type": "watch", "run": []}',
    ],
    ids=["deep", "infinity", "nan", "twice", "surrogate", "long", "list"],
)
def test_a_malformed_message_gets_a_short_line_and_the_channel_stays(message: str, server: Server) -> None:
    async def talk() -> list[dict]:
        async with aiohttp.ClientSession() as session:
            address = f"http://127.0.0.1:{server.port}/channel"
            async with session.ws_connect(address, headers={"Cookie": server.cookie}) as channel:
                await channel.send_str(message)
                await channel.send_json({"type": "hello", "version": 1})
                return [await asyncio.wait_for(channel.receive_json(), PATIENCE_S) for _ in range(2)]

    error, hello = asyncio.run(talk())
    assert error["type"] == "error" and error["text"].isprintable() and len(error["text"]) <= 2000
    assert hello["type"] == "hello"
