"""Meshcat page behind a gateway: a random token in its address, an allow-list of origins, and checked messages.

Meshcat's own server accepts any connection and parses any bytes: a web page in the same browser could move the sliders,
and one malformed byte ends the process. `MeshcatPage` connects the gateway to this server and closes the server's port.
"""

from __future__ import annotations

import json
import logging
import os
import secrets
import socket
import stat
import subprocess
import sys
import weakref
from collections.abc import Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

from pydrake.common import FindResourceOrThrow
from pydrake.geometry import Meshcat, MeshcatParams

END_TIMEOUT = 5.0  # longest wait for the gateway to exit before it is killed [s]


GATEWAY_MODULES = ("msgpack", "websockets")  # modules outside of the standard library that the gateway imports
# Program that runs the gateway. Python's option -I excludes the current folder, PYTHONPATH and the user's packages, so
# the folders of the gateway's modules are appended to the path.
_START = "import runpy, sys; sys.path += sys.argv[2:]; runpy.run_path(sys.argv[1], run_name='__main__')"


def _folders(modules: Sequence[str]) -> list[str]:
    """Return the absolute paths of the folders from which this process imports modules.

    Raises:
        RuntimeError: If a module is not installed.
    """
    folders = []
    for module in modules:
        spec = find_spec(module)
        if spec is None or spec.origin is None:
            raise RuntimeError(f"the module {module} is missing, install it with pip install {module}")
        folders.append(str(Path(spec.origin).resolve().parent.parent))
    return list(dict.fromkeys(folders))


class MeshcatPage(Meshcat):
    """Meshcat whose page has a secret address; everything else is as in the base class.

    The page and its websocket are at a path with a random token. A request without the token is refused, and so is a
    websocket whose origin is not this page. The gateway parses the messages of browsers: Meshcat receives only the
    states of gamepads, and inputs of existing controls within their range.

    Args:
        is_served: True if browsers may connect; if False, the page can only be exported with `StaticHtml`.

    Raises:
        RuntimeError: If `DRAKE_ALLOW_NETWORK` forbids Meshcat, a module of the gateway is missing, the gateway ends at
            its start, or Meshcat's own port cannot be closed.
    """

    def __init__(self, *, is_served: bool = True):
        drake_logger = logging.getLogger("drake")
        level = drake_logger.level
        drake_logger.setLevel(logging.WARNING)  # Drake would log the address of Meshcat's own server
        try:
            super().__init__(MeshcatParams(host="localhost"))
        finally:
            drake_logger.setLevel(level)
        self._gateway = _Gateway(super().port()) if is_served else None
        if self._gateway is None:
            _close_port(super().port(), keep=())
        else:
            self._close = weakref.finalize(self, self._gateway.close)

    def close(self) -> None:
        """Disconnect all browsers, and accept no new connections."""
        if self._gateway is not None:
            self._close()

    def port(self) -> int:
        """Return the port of the page; 0 if it is not served."""
        return 0 if self._gateway is None else self._gateway.port

    def web_url(self) -> str:
        """Return the address of the page, with its token; empty if it is not served."""
        return "" if self._gateway is None else f"http://localhost:{self.port()}/{self._gateway.token}/"

    def ws_url(self) -> str:
        """Return the address of the page's websocket, with its token; empty if it is not served."""
        return self.web_url().replace("http://", "ws://")

    def GetNumActiveConnections(self) -> int:
        """Return the number of connected browsers."""
        return 0 if self._gateway is None else self._gateway.read_browsers()


class _Gateway:
    """Gateway process of a page; see `page_gateway`.

    Attributes:
        port: Port of the page.
        token: Secret part of the page's address.
    """

    def __init__(self, meshcat_port: int):
        """Start the gateway, wait until it is connected to Meshcat's server, and close the port of that server."""
        self.token, self._num_browsers, self._rest = secrets.token_urlsafe(24), 0, b""
        gateway = str(Path(__file__).with_name("page_gateway.py"))
        program = [sys.executable, "-I", "-c", _START, gateway, *_folders(GATEWAY_MODULES)]
        self._process = subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._input, self._output = self._process.stdin, self._process.stdout
        html, script = (FindResourceOrThrow(f"drake/geometry/meshcat.{ending}") for ending in ("html", "js"))
        files = {"": html, "index.html": html, "meshcat.js": script}
        try:
            self._send(json.dumps({"port": meshcat_port, "token": self.token, "files": files}))
            _close_port(meshcat_port, keep=[int(port) for port in self._receive().split()])
            self._send("serve")
            self.port = int(self._receive())
            os.set_blocking(self._output.fileno(), False)
        except BaseException:
            self.close()
            raise

    def _send(self, line: str) -> None:
        self._input.write(f"{line}\n".encode())
        self._input.flush()

    def _receive(self) -> str:
        line = self._output.readline().decode()
        if not line:
            raise RuntimeError("the gateway of the page has ended")
        return line

    def read_browsers(self) -> int:
        """Return the number of connected browsers; 0 after the process has ended."""
        received = b"" if self._output.closed else self._output.read()
        if received == b"":  # the gateway has ended; while it runs, `read` returns None if there is no new number
            return 0
        *lines, self._rest = (self._rest + (received or b"")).split(b"\n")
        if lines:
            self._num_browsers = int(lines[-1])
        return self._num_browsers

    def close(self) -> None:
        """End the process."""
        for pipe in (self._input, self._output):
            with suppress(OSError):
                pipe.close()
        try:
            self._process.wait(END_TIMEOUT)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _close_port(port: int, keep: Sequence[int]) -> None:
    """Replace the socket that listens on a port by an unconnected socket, and end the port's connections.

    Drake has no function to close the port. Connections to peers with the ports `keep` stay open. The number of the
    socket's file descriptor does not change, so that Drake can still close it.

    Raises:
        RuntimeError: If no socket of this process listens on the port.
    """
    is_closed = False
    for descriptor in map(int, os.listdir("/dev/fd")):
        with suppress(OSError):  # the descriptor or its connection was closed after it was listed
            if not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
                continue
            with socket.socket(fileno=os.dup(descriptor)) as duplicate, socket.socket() as unconnected:
                if duplicate.family not in (socket.AF_INET, socket.AF_INET6) or duplicate.getsockname()[1] != port:
                    continue
                if duplicate.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
                    os.dup2(unconnected.fileno(), descriptor, inheritable=False)
                    is_closed = True
                elif duplicate.getpeername()[1] not in keep:
                    duplicate.shutdown(socket.SHUT_RDWR)
    if not is_closed:
        raise RuntimeError("Meshcat's own port cannot be closed on this system")
