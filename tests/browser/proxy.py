"""A reverse proxy as a process: passes what lies below a path prefix on to a server, HTTP and websockets.

    python -m tests.browser.proxy PREFIX UPSTREAM_PORT [--keep-host]      prints its port

It strips the prefix and sets `Host` to the server's, as proxies do by default; --keep-host leaves it.
"""

from __future__ import annotations

import asyncio
import sys
from typing import Any

import aiohttp
from aiohttp import web

HOP_BY_HOP = {"connection", "keep-alive", "transfer-encoding", "upgrade", "content-encoding", "content-length"}


async def main(prefix: str, upstream: str, keeps_host: bool) -> None:
    async with aiohttp.ClientSession(auto_decompress=False, cookie_jar=aiohttp.DummyCookieJar()) as session:

        async def answer(request: web.Request) -> web.StreamResponse:
            headers = {name: value for name, value in request.headers.items() if name.lower() not in HOP_BY_HOP}
            if not keeps_host:
                headers["Host"] = upstream
            path = request.raw_path.removeprefix(prefix)
            if request.headers.get("Upgrade", "").lower() == "websocket":
                own = {name: value for name, value in headers.items() if not name.lower().startswith("sec-websocket")}
                return await relay(request, f"http://{upstream}{path}", own)
            body = await request.read()
            async with session.request(
                request.method, f"http://{upstream}{path}", headers=headers, data=body, allow_redirects=False
            ) as found:
                headers = [
                    (n, v) for n, v in found.headers.items() if n.lower() not in HOP_BY_HOP - {"content-encoding"}
                ]
                return web.Response(status=found.status, headers=headers, body=await found.read())

        async def relay(request: web.Request, address: str, headers: dict[str, str]) -> web.WebSocketResponse:
            page = web.WebSocketResponse(max_msg_size=0)
            await page.prepare(request)
            async with session.ws_connect(address, headers=headers, max_msg_size=0) as server:

                async def pump(source: Any, sink: Any) -> None:
                    async for message in source:
                        if message.type == aiohttp.WSMsgType.TEXT:
                            await sink.send_str(message.data)
                        elif message.type == aiohttp.WSMsgType.BINARY:
                            await sink.send_bytes(message.data)

                tasks = [asyncio.create_task(pump(page, server)), asyncio.create_task(pump(server, page))]
                await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
                for task in tasks:
                    task.cancel()
                await page.close()
            return page

        app = web.Application(client_max_size=64 << 20)
        app.add_routes([web.route("*", f"{prefix}{{rest:/.*}}", answer)])
        runner = web.AppRunner(app)
        await runner.setup()
        site = web.TCPSite(runner, "127.0.0.1", 0)
        await site.start()
        print(runner.addresses[0][1], flush=True)
        await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], f"127.0.0.1:{sys.argv[2]}", "--keep-host" in sys.argv))
