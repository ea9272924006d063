"""Demonstrations by a scripted operator that presses keys on a page in headless Chromium.

`python packages/hardware/tests/teleop/record_in_browser.py TASK OUT.npz [SCREENSHOT.png]`, with Chromium and
websockets installed.
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
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import websockets

from guiderail.diagrams.stations.station import CONTROL_PERIOD as PERIOD
from guiderail.models.objects.bnc_connector.demonstrations import RIM, SEARCH_PUSH, SEAT_COMMAND
from guiderail.tools.environments import task_named
from guiderail_hardware.teleop.recorder import SLIDERS, DemonstrationRecorder

PORT = 9333  # port of the browser's DevTools
COUNT = 5  # number of demonstrations


class Page:
    """Tab of a browser, controlled by the Chrome DevTools protocol."""

    def __init__(self, socket):
        self._socket, self._number, self._lock = socket, 0, asyncio.Lock()

    async def call(self, method, **parameters):
        """Call a method of the protocol and return its result."""
        async with self._lock:
            self._number += 1
            await self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
            while True:
                answer = json.loads(await self._socket.recv())
                if answer.get("id") == self._number:
                    return answer.get("result", answer)

    async def press(self, code):
        """Press and release a key, given by JavaScript's code."""
        key = code.removeprefix("Key").lower()
        for kind in ("keyDown", "keyUp"):
            await self.call("Input.dispatchKeyEvent", type=kind, code=code, key=key)


class Operator:
    """Scripted operator that reads the commanded pose and presses keys one after the other."""

    def __init__(self, page, session, seed):
        self.page, self.session, self.random = page, session, np.random.default_rng(seed)

    async def press(self, code, times=1):
        """Press a key a number of times, with random pauses."""
        for _ in range(times):
            await self.page.press(code)
            await asyncio.sleep(self.random.uniform(0.02, 0.06))

    async def wait(self, seconds):
        """Wait for some simulated time [s]."""
        until = self.session.steps * PERIOD + seconds
        while self.session.steps * PERIOD < until:
            await asyncio.sleep(0.02)

    async def settle(self):
        """Wait until the page has handled all keys, which can take seconds."""
        offset = None
        while not np.array_equal(offset, self.session.offset):
            offset = self.session.offset.copy()
            await asyncio.sleep(0.4)
            await self.wait(0.1)

    async def set_output(self, output, target):
        """Press keys until an output of the desired pose has a value [m] or [rad]."""
        slider = list(SLIDERS.values())[output]
        for _ in range(5):
            value = self.session.start[output] + self.session.offset[output]
            steps = round((target - value) / (slider.step * slider.scale))
            if steps == 0:
                return
            await self.press(slider.keys[steps > 0], abs(steps))
            await self.settle()

    async def search(self, seconds):
        """Move randomly over the rim in steps of 0.5 mm for some simulated time [s], then return to the center."""
        until = self.session.steps * PERIOD + seconds
        while self.session.steps * PERIOD < until:
            for output, steps in enumerate(self.random.integers(-3, 4, size=2)):
                await self.set_output(output, 0.5e-3 * steps)
        await self.set_output(0, 0.0)
        await self.set_output(1, 0.0)

    async def demonstrate(self, motion, picture=None):
        """Demonstrate an insertion: approach the rim, search, push in, turn if the task has a turn, and rest.

        A screenshot is written to the file `picture`, if given, during the push.
        """
        await self.wait(0.3)
        await self.set_output(2, motion.rim - motion.press)
        await self.wait(0.3)
        await self.search(1.5)
        await self.set_output(2, -motion.push)
        await self.wait(0.9)
        if picture is not None:
            await save_screenshot(self.page, picture)
        if motion.turn:
            await self.set_output(3, self.session.start[3] + np.deg2rad(motion.turn))
            await self.set_output(2, -motion.push - 2e-3)
            await self.wait(0.9)
        await self.set_output(2, 0.0)
        await self.wait(0.6)
        await self.press("Enter")


@dataclass(frozen=True)
class Insertion:
    """Motion of an insertion: heights of the rim and of commands below contact [m], and a turn [degrees]."""

    rim: float
    press: float
    push: float
    turn: float


def insertion_of(session):
    """Return the motion of a task folder, or of the connector if the task has no folder."""
    file = getattr(session.task, "file", None)
    if file is None:
        return Insertion(RIM, SEARCH_PUSH, -SEAT_COMMAND, -90.0)
    return Insertion(file.motion.rim, file.motion.press, file.motion.push, file.motion.turn)


async def operate(url, session, is_connected, picture):
    """Record `COUNT` demonstrations on the page at `url`; `is_connected` is an event."""
    target = next(
        tab for tab in json.load(urllib.request.urlopen(f"http://localhost:{PORT}/json")) if tab["type"] == "page"
    )
    async with websockets.connect(target["webSocketDebuggerUrl"], max_size=None) as socket:
        page = Page(socket)
        await page.call("Page.enable")
        await page.call("Page.navigate", url=url)
        while not is_connected.is_set():
            await asyncio.sleep(0.2)
        await asyncio.sleep(2.0)
        await page.press("KeyM")  # slow motion, because the page handles keys slowly
        for number in range(COUNT):
            count = len(session.demonstrations)
            operator = Operator(page, session, number)
            await operator.page.press("Backspace")  # reset before the demonstration
            await asyncio.sleep(0.5)
            await operator.demonstrate(insertion_of(session), picture if number == 0 else None)
            while len(session.demonstrations) == count:
                await asyncio.sleep(0.1)
        if picture is not None:
            await save_screenshot(page, picture.with_stem(picture.stem + "-end"))
        await page.press("Escape")


async def save_screenshot(page, picture):
    screenshot = await page.call("Page.captureScreenshot", format="png")
    picture.write_bytes(base64.b64decode(screenshot["data"]))


def main(task, out, picture=None):
    name, _ = task_named(task)
    session = DemonstrationRecorder(name, {}, Path(out))
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
        session.reset()
        is_connected = threading.Event()
        operation = operate(
            session.panel.meshcat.web_url(), session, is_connected, None if picture is None else Path(picture)
        )
        operator = threading.Thread(target=asyncio.run, args=(operation,))
        operator.start()
        # Meshcat must be called from the thread that created it.
        while session.panel.meshcat.GetNumActiveConnections() == 0:
            threading.Event().wait(0.1)
        is_connected.set()
        session.run(print, max_steps=100_000)
        operator.join()
        print(json.dumps(session.summarize()))
    finally:
        browser.terminate()
        browser.wait()


if __name__ == "__main__":
    main(*sys.argv[1:])
