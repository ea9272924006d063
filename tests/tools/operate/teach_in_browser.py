"""Demonstrations by a scripted person at a real page: headless Chromium, whose keys are pressed as a person would.

`python tests/tools/operate/teach_in_browser.py TASK OUT.npz [SCREENSHOT.png]`; it needs chromium and websockets.
"""

import asyncio
import base64
import json
import shutil
import subprocess
import sys
import tempfile
import threading
import urllib.request
from pathlib import Path

import websockets

from guiderail.tools.operate.teach import Teaching
from guiderail.tools.tasks import task_named

PORT = 9333
COUNT = 3


class Page:
    """A tab, by Chromium's own protocol."""

    def __init__(self, socket):
        self._socket, self._number = socket, 0

    async def call(self, method, **parameters):
        self._number += 1
        await self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(await self._socket.recv())
            if answer.get("id") == self._number:
                return answer.get("result", answer)

    async def press(self, code, times=1):
        for _ in range(times):
            key = code.removeprefix("Key").lower()
            for kind in ("keyDown", "keyUp"):
                await self.call("Input.dispatchKeyEvent", type=kind, code=code, key=key)
            await asyncio.sleep(0.03)


async def person(url, session, travel, picture):
    target = next(
        tab for tab in json.load(urllib.request.urlopen(f"http://localhost:{PORT}/json")) if tab["type"] == "page"
    )
    async with websockets.connect(target["webSocketDebuggerUrl"], max_size=None) as socket:
        page = Page(socket)
        await page.call("Page.enable")
        await page.call("Page.navigate", url=url)
        while session.meshcat.GetNumActiveConnections() == 0:
            await asyncio.sleep(0.2)
        await asyncio.sleep(2.0)
        for number in range(COUNT):
            await page.press(("KeyD", "KeyA", "KeyW")[number % 3], 1)
            await page.press("KeyF", round(0.6 * travel / 0.5e-3))
            await asyncio.sleep(1.0)
            await page.press(("KeyA", "KeyD", "KeyS")[number % 3], 1)
            await page.press("KeyF", round(0.4 * travel / 0.5e-3) + 6)
            await asyncio.sleep(3.0)
            if picture is not None and number == 0:
                shot = await page.call("Page.captureScreenshot", format="png")
                picture.write_bytes(base64.b64decode(shot["data"]))
            await page.press("Enter")
            await asyncio.sleep(1.0)
        await page.press("Escape")


def main(task, out, picture=None):
    name, _ = task_named(task)
    session = Teaching(name, {}, Path(out))
    profile = tempfile.mkdtemp()
    browser = subprocess.Popen(
        [
            shutil.which("chromium"), "--headless=new", "--no-sandbox", f"--remote-debugging-port={PORT}",
            f"--user-data-dir={profile}", "--window-size=1200,800", "--enable-unsafe-swiftshader", "about:blank",
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        for _ in range(60):
            try:
                urllib.request.urlopen(f"http://localhost:{PORT}/json")
                break
            except OSError:
                threading.Event().wait(0.5)
        session.begin()
        travel = float(session.start[2])
        at_page = person(session.meshcat.web_url(), session, travel, None if picture is None else Path(picture))
        hands = threading.Thread(target=asyncio.run, args=(at_page,))
        hands.start()
        session.run(print, most_steps=20_000)
        hands.join()
        print(json.dumps(session.learned()))
    finally:
        browser.terminate()
        browser.wait()


if __name__ == "__main__":
    main(*sys.argv[1:])
