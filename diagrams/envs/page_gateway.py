"""Gateway between Meshcat's server and browsers: a separate program, started by `MeshcatPage`.

Its first line of input is JSON: the port of Meshcat's server, the token, and the files of the page by name. The gateway
prints the local ports of its connections to that server and waits for a second line of input. It then prints the port
of the page, and afterwards the number of connected browsers at each change. It exits when its input ends or Meshcat
disconnects.

The gateway imports nothing from guiderail. It is not a thread of the simulating program, because the garbage collector
might delete Meshcat in that thread, which would crash the program.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import logging
import math
import re
import signal
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from http import HTTPStatus
from pathlib import Path
from typing import Any, TypeAlias

import msgpack
from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

HOST = "127.0.0.1"
MAX_MESSAGE = 10_000  # largest message of a browser [bytes]; a gamepad message has a few hundred bytes
MAX_WAITING = 100_000  # queue length [frames] above which a slow browser is disconnected; the browser then reconnects
MAX_GAMEPAD = 64  # largest number of gamepads, and of axes and buttons of each
ASSET_PERIOD = 3.0  # period of requests on the asset connection [s]; Meshcat closes a connection without requests

Controls: TypeAlias = Mapping[str, tuple[float, float] | None]
"""Range of each slider; None for a button."""

_ASSET = re.compile(rb"cas-v1/[0-9a-f]{64}")  # texture or mesh that a frame refers to
_HEADERS = {"Cache-Control": "no-store", "Referrer-Policy": "no-referrer", "X-Frame-Options": "DENY"}
_KINDS = {".js": "text/javascript", ".html": "text/html; charset=utf-8"}
_QUIET = logging.getLogger(__name__)  # logger that omits refused connections
_QUIET.setLevel(logging.CRITICAL)


class SceneCache:
    """Cache of the frames from which a new browser builds the current scene, in the order in which they were sent.

    Attributes:
        controls: Range of each slider that exists; None for a button.
    """

    def __init__(self) -> None:
        self.controls: dict[str, tuple[float, float] | None] = {}
        self._frames: dict[tuple[str, ...], bytes] = {}

    def frames(self) -> list[bytes]:
        """Return the cached frames, oldest first."""
        return list(self._frames.values())

    def add(self, frame: bytes) -> None:
        """Add a frame from Meshcat, and remove the frames that it makes obsolete."""
        key = _key(frame)
        if key[0] == "delete":
            self._remove(lambda other: other[0].startswith("set_") and _is_below(other[1], key[1]))
        elif key[0] in ("set_control", "delete_control"):
            self._remove(lambda other: other[0] in ("set_control", "set_control_value") and other[1] == key[1])
            self.controls.pop(key[1], None)
            if key[0] == "delete_control":
                return
            control = msgpack.unpackb(frame)
            self.controls[key[1]] = (control["min"], control["max"]) if "min" in control else None
        self._frames.pop(key, None)  # the newest frame becomes the last
        self._frames[key] = frame

    def _remove(self, is_obsolete: Callable[[tuple[str, ...]], bool]) -> None:
        for key in [key for key in self._frames if is_obsolete(key)]:
            del self._frames[key]


def _key(frame: bytes) -> tuple[str, ...]:
    """Return a frame's type, its path or name, and its property; a later frame with the same key replaces the frame."""
    unpacker = msgpack.Unpacker(max_buffer_size=0)
    unpacker.feed(frame)
    fields = {"type": "", "path": "", "name": "", "property": ""}
    for _ in range(unpacker.read_map_header()):
        field = unpacker.unpack()
        if field not in fields:  # the rest is content, which may be large
            break
        fields[field] = unpacker.unpack()
    return fields["type"], fields["path"] or fields["name"], fields["property"]


def _is_below(path: str, parent: str) -> bool:
    return path == parent or path.startswith(f"{parent.rstrip('/')}/")


def parse_event(message: bytes | str, controls: Controls) -> dict[str, Any] | None:
    """Convert a browser's message, which may be any bytes, to the event that Meshcat expects; None if it is invalid.

    `controls` are the controls that exist.
    """
    if not isinstance(message, bytes) or len(message) > MAX_MESSAGE:
        return None
    try:
        event = msgpack.unpackb(message, strict_map_key=True, max_ext_len=0)
    except Exception:  # msgpack raises various exceptions, such as ValueError and RecursionError
        return None
    if not isinstance(event, dict):
        return None
    kind, name = event.get("type"), event.get("name")
    if kind == "gamepad":
        gamepad = _parse_gamepad(event.get("gamepad"))
        return None if gamepad is None else {"type": "gamepad", "name": "", "gamepad": gamepad}
    if not isinstance(name, str) or name not in controls:
        return None
    limits = controls[name]
    if kind == "button" and limits is None:
        return {"type": "button", "name": name}
    value: Any = event.get("value")
    if kind == "slider" and limits is not None and _is_finite(value):
        return {"type": "slider", "name": name, "value": min(max(float(value), limits[0]), limits[1])}
    return None


def _parse_gamepad(gamepad: Any) -> dict[str, Any] | None:
    """Return a gamepad's state with clamped values; empty for a disconnected gamepad, None if it is invalid."""
    if gamepad == {}:
        return {}
    if not isinstance(gamepad, dict):
        return None
    index, buttons, axes = gamepad.get("index"), gamepad.get("button_values"), gamepad.get("axes")
    if type(index) is not int or not 0 <= index < MAX_GAMEPAD:
        return None
    for values in (buttons, axes):
        if not isinstance(values, list) or len(values) > MAX_GAMEPAD or not all(map(_is_finite, values)):
            return None
    return {"index": index, "button_values": _clamp(buttons, 0.0), "axes": _clamp(axes, -1.0)}


def _clamp(values: Any, lowest: float) -> list[float]:
    return [min(max(float(value), lowest), 1.0) for value in values]


def _is_finite(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


class Gateway:
    """Server of a page; it is the only client of Meshcat's server.

    Args:
        port: Port of Meshcat's server. After it is closed, the page uses this port, or another one if it is not free.
        token: Secret part of the page's address.
        files: Paths of the page's files by name.
    """

    def __init__(self, port: int, token: str, files: Mapping[str, str]):
        self.port, self.token = port, token
        self._cache = SceneCache()
        self._queues: dict[ServerConnection, asyncio.Queue[bytes]] = {}
        self._gamepad_owner: ServerConnection | None = None
        self._files = {name: (_KINDS[Path(file).suffix], Path(file).read_bytes()) for name, file in files.items()}

    async def run(self) -> None:
        """Connect, wait until Meshcat's port is closed, and serve the page until Meshcat or the input ends."""
        url = f"ws://localhost:{self.port}/"
        options: dict[str, Any] = {"max_size": None, "compression": None, "ping_interval": None, "logger": _QUIET}
        async with connect(url, proxy=None, **options) as meshcat, _Assets(self.port) as assets:
            print(meshcat.local_address[1], assets.local_port, flush=True)
            if not await asyncio.to_thread(sys.stdin.readline):
                return
            self._meshcat = meshcat
            server = await self._listen()
            self.port = next(iter(server.sockets)).getsockname()[1]
            print(self.port, flush=True)
            reading = asyncio.create_task(self._read(meshcat, assets))
            asyncio.get_running_loop().add_reader(sys.stdin.fileno(), reading.cancel)  # called at the end of input
            with suppress(ConnectionClosed, asyncio.CancelledError):
                await reading

    async def _read(self, meshcat: ClientConnection, assets: _Assets) -> None:
        while True:
            frame = await meshcat.recv()
            assert isinstance(frame, bytes)
            for name in {match.decode() for match in _ASSET.findall(frame)} - self._files.keys():
                self._files[name] = ("application/octet-stream", await assets.read(name))
            self._publish(frame)

    async def _listen(self) -> Server:
        """Listen on Meshcat's former port, or on any free port if another program has taken it."""
        for port in (self.port, 0):
            with suppress(OSError):
                return await serve(
                    self._serve_browser, HOST, port, process_request=self._answer, max_size=MAX_MESSAGE,
                    compression=None, server_header=None, logger=_QUIET,
                )  # fmt: skip
        raise OSError("no port is free")

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the response to a request; None accepts a websocket with a valid token and origin."""
        token, _, name = request.path.partition("?")[0].removeprefix("/").partition("/")
        if not hmac.compare_digest(token.encode(), self.token.encode()):
            return _response(HTTPStatus.NOT_FOUND, "text/plain", b"use the address that the program prints\n")
        if "upgrade" in request.headers.get("Connection", "").lower():
            hosts = ("localhost", HOST, "[::1]")
            if request.headers.get_all("Origin") not in [[f"http://{host}:{self.port}"] for host in hosts]:
                return _response(HTTPStatus.FORBIDDEN, "text/plain", b"another origin\n")
            return None
        if name not in self._files:
            return _response(HTTPStatus.NOT_FOUND, "text/plain", b"no such file\n")
        return _response(HTTPStatus.OK, *self._files[name])

    async def _serve_browser(self, browser: ServerConnection) -> None:
        queue: asyncio.Queue[bytes] = asyncio.Queue()
        for frame in self._cache.frames():
            queue.put_nowait(frame)
        self._queues[browser] = queue
        print(len(self._queues), flush=True)
        sender = asyncio.create_task(_send(queue, browser))
        try:
            async for message in browser:
                if (event := parse_event(message, self._cache.controls)) is not None:
                    await self._forward(event, browser)
        except ConnectionClosed:
            pass
        finally:
            sender.cancel()
            del self._queues[browser]
            print(len(self._queues), flush=True)
            if browser is self._gamepad_owner:  # Meshcat would keep the sticks' last deflection
                self._gamepad_owner = None
                with suppress(ConnectionClosed):
                    await self._meshcat.send(msgpack.packb({"type": "gamepad", "name": "", "gamepad": {}}))

    async def _forward(self, event: Mapping[str, Any], browser: ServerConnection) -> None:
        """Forward a browser's event to Meshcat, and a slider's value to the other browsers."""
        await self._meshcat.send(msgpack.packb(event))
        if event["type"] == "gamepad":
            self._gamepad_owner = browser
        elif event["type"] == "slider":
            value = {"name": event["name"], "value": event["value"], "invoke_callback": False}
            self._publish(msgpack.packb({"type": "set_control_value", **value}), sender=browser)

    def _publish(self, frame: bytes, sender: ServerConnection | None = None) -> None:
        """Send a frame to all browsers except its `sender`, and disconnect browsers that are too slow."""
        self._cache.add(frame)
        for browser, queue in self._queues.items():
            if queue.qsize() > MAX_WAITING:
                browser.transport.abort()
            elif browser is not sender:
                queue.put_nowait(frame)


class _Assets:
    """Connection that reads meshes and textures from Meshcat's server, opened before the server's port is closed.

    Attributes:
        local_port: Local port of the connection.
    """

    def __init__(self, port: int):
        self._port, self._lock = port, asyncio.Lock()

    async def __aenter__(self) -> _Assets:
        self._reader, self._writer = await asyncio.open_connection("localhost", self._port)
        self.local_port = self._writer.get_extra_info("sockname")[1]
        self._keeper = asyncio.create_task(self._keep_open())
        return self

    async def __aexit__(self, *error: object) -> None:
        self._keeper.cancel()
        self._writer.close()

    async def read(self, name: str) -> bytes:
        """Return a file of Meshcat's server; empty if there is none, or the connection was lost."""
        if self._reader.at_eof() or self._writer.is_closing():
            return b""
        with suppress(OSError, asyncio.IncompleteReadError, ValueError):
            async with self._lock:
                self._writer.write(f"GET /{name} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
                head = (await self._reader.readuntil(b"\r\n\r\n")).lower()
                size = int(head.partition(b"content-length:")[2].split(b"\r\n")[0] or 0)
                content = await self._reader.readexactly(size)
                return content if b" 200 " in head.split(b"\r\n")[0] else b""
        return b""

    async def _keep_open(self) -> None:
        while True:
            await asyncio.sleep(ASSET_PERIOD)
            await self.read("favicon.ico")


async def _send(queue: asyncio.Queue[bytes], browser: ServerConnection) -> None:
    with suppress(ConnectionClosed):
        while True:
            await browser.send(await queue.get())


def _response(status: HTTPStatus, kind: str, content: bytes) -> Response:
    fields = {"Content-Type": kind, "Content-Length": str(len(content)), "Connection": "close", **_HEADERS}
    return Response(status.value, status.phrase, Headers(fields), content)


def main() -> None:
    """Run the gateway."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the simulating program, which closes the gateway's input
    asyncio.run(Gateway(**json.loads(sys.stdin.readline())).run())


if __name__ == "__main__":
    main()
