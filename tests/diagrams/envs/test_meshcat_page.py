"""Meshcat page: access by token and origin, messages of browsers, cache of the scene, and release of resources."""

import gc
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from importlib.util import find_spec
from pathlib import Path

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.geometry import Sphere
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from guiderail.diagrams.envs import meshcat_page
from guiderail.diagrams.envs.meshcat_page import MeshcatPage
from guiderail.diagrams.envs.page_gateway import MAX_GAMEPAD, SceneCache, parse_event
from guiderail.diagrams.envs.scene import open_meshcat
from guiderail.models.common.errors import InputError

CONTROLS = {"x": (-2.0, 2.0), "keep": None}
GAMEPAD = {"index": 0, "button_values": [0.5], "axes": [0.25, -1.0]}
PAGES = []  # all pages, because the garbage collector must not delete Meshcat in the thread of a client


@pytest.fixture(scope="module")
def module_page():
    PAGES.append(page := MeshcatPage())
    page.AddSlider("x", -2.0, 2.0, 0.5, 0.0, "KeyA", "KeyD")
    page.AddButton("keep", "Enter")
    page.Flush()
    yield page
    page.close()


@pytest.fixture
def page(module_page):
    """Return the page of the module with its slider at zero, and store its number of button clicks."""
    module_page.SetSliderValue("x", 0.0)
    module_page.clicks_before = module_page.GetButtonClicks("keep")
    return module_page


def origin(page, host="localhost"):
    return f"http://{host}:{page.port()}"


def browser(page, **changed):
    """Return a WebSocket client of the page; `changed` replaces arguments of the connection."""
    return connect(**({"uri": page.ws_url(), "origin": origin(page), "compression": None, "proxy": None} | changed))


def wait_until(condition):
    for _ in range(500):
        if condition():
            return
        time.sleep(0.01)
    raise TimeoutError


def inputs(page):
    """Return the slider's value, the number of new clicks, and the axes of the gamepad."""
    return page.GetSliderValue("x"), page.GetButtonClicks("keep") - page.clicks_before, list(page.GetGamepad().axes)


def test_browser_with_token_and_origin_moves_the_controls(page):
    for host in ("localhost", "127.0.0.1"):
        with browser(page, origin=origin(page, host)) as client:
            clicks = inputs(page)[1]
            client.send(msgpack.packb({"type": "slider", "name": "x", "value": 7}))  # above the slider's maximum of 2
            client.send(msgpack.packb({"type": "gamepad", "name": "", "gamepad": GAMEPAD}))
            client.send(msgpack.packb({"type": "button", "name": "keep"}))
            wait_until(lambda clicks=clicks: inputs(page)[1] == clicks + 1)
            assert inputs(page) == (2.0, clicks + 1, [0.25, -1.0])
            assert page.GetNumActiveConnections() == 1
        # The gamepad's axes are cleared when its browser disconnects.
        wait_until(lambda: not page.GetGamepad().axes)
        wait_until(lambda: page.GetNumActiveConnections() == 0)


@pytest.mark.parametrize(
    ("changed", "status"),
    [
        ({"path": ""}, 404),
        ({"path": "/" + "A" * 32}, 404),
        ({"token": lambda token: token[:-1]}, 404),
        ({"token": lambda token: token + "A"}, 404),
        ({"token": lambda token: token.swapcase()}, 404),
        ({"origin": None}, 403),
        ({"origin": "null"}, 403),
        ({"origin": "http://localhost"}, 403),
        ({"origin": "http://localhost:1"}, 403),
        ({"origin": "http://example.org"}, 403),
        ({"origin": "https://localhost:{port}"}, 403),
        ({"origin": "http://localhost:{port}.example.org"}, 403),
    ],
)
def test_connection_is_refused_without_token_or_origin(page, changed, status):
    token = page._gateway.token
    path = changed.get("path", f"/{changed.get('token', str)(token)}/")
    allowed = changed.get("origin", origin(page))
    allowed = allowed and allowed.format(port=page.port())
    with (
        pytest.raises(InvalidStatus) as refused,
        browser(page, uri=f"ws://localhost:{page.port()}{path}", origin=allowed) as client,
    ):
        client.send(msgpack.packb({"type": "button", "name": "keep"}))
    assert refused.value.response.status_code == status
    assert inputs(page) == (0.0, 0, [])


def test_files_are_served_only_with_the_token(page):
    address = page.web_url()
    for name, size in (("", 5_000), ("meshcat.js", 500_000)):
        with urllib.request.urlopen(address + name) as answer:
            assert len(answer.read()) > size
            assert answer.headers["X-Frame-Options"] == "DENY"
    for wrong in (address.replace(page._gateway.token, "x"), address + "config.yaml", address + "../etc/passwd"):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(wrong)


@pytest.mark.parametrize("is_killed", [False, True])
def test_page_has_no_connections_after_its_end(is_killed):
    PAGES.append(page := MeshcatPage())
    with browser(page):
        wait_until(lambda: page.GetNumActiveConnections() == 1)
        assert page.GetNumActiveConnections() == 1  # the gateway has printed no new count
        if is_killed:
            page._gateway._process.kill()
        else:
            page.close()
        wait_until(lambda: page.GetNumActiveConnections() == 0)
    page.close()
    assert page.GetNumActiveConnections() == 0


def test_server_of_meshcat_accepts_no_connection():
    """Only the gateway listens, because a malformed byte can end the server inside Meshcat."""
    PAGES.append(page := MeshcatPage(is_served=False))
    port = super(MeshcatPage, page).port()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("localhost", port), 1.0)
    page.SetTransform("/a", np.eye(4))
    assert len(page.StaticHtml()) > 500_000
    assert (page.web_url(), page.port(), page.GetNumActiveConnections()) == ("", 0, 0)


@pytest.mark.parametrize("message", [b"\xc1", b"", b"\x81", "text", b"\xdd\xff\xff\xff\xff", b"\x91" * 5_000])
def test_malformed_message_is_ignored(page, message):
    with browser(page) as client:
        client.send(message)
        client.send(msgpack.packb({"type": "button", "name": "keep"}))
        wait_until(lambda: inputs(page)[1] == 1)
    page.SetTransform("/a", np.eye(4))
    assert inputs(page) == (0.0, 1, [])


def receive_all(client):
    """Return the messages that arrive until there is none for 0.3 s."""
    messages = []
    try:
        while True:
            messages.append(msgpack.unpackb(client.recv(timeout=0.3)))
    except TimeoutError:
        return messages


def test_new_browser_receives_the_current_scene(page):
    page.SetObject("/present", Sphere(1.0))
    page.SetTransform("/present", np.eye(4))
    page.SetTransform("/present", 2.0 * np.eye(4))
    page.SetObject("/deleted/part", Sphere(1.0))
    page.Delete("/deleted")
    page.AddButton("end")
    page.DeleteButton("end")
    page.SetSliderValue("x", 1.5)
    with browser(page) as first:
        receive_all(first)  # until the gateway has received every frame
    with browser(page) as client, browser(page) as second:
        messages = receive_all(client)
        assert {m["path"] for m in messages if m["type"] == "set_object"} == {"/present"}
        assert [m["matrix"][0] for m in messages if m.get("path") == "/present" and "matrix" in m] == [2.0]
        assert {m["name"] for m in messages if m["type"] == "set_control"} == {"x", "keep"}
        assert [m["value"] for m in messages if m["type"] == "set_control_value"] == [1.5]
        receive_all(second)
        client.send(msgpack.packb({"type": "slider", "name": "x", "value": -1.0}))
        assert [(m["name"], m["value"]) for m in receive_all(second)] == [("x", -1.0)]
        page.SetTransform("/present", 3.0 * np.eye(4))
        assert [m["matrix"][0] for m in receive_all(second)] == [3.0]


def test_page_leaves_no_process_port_or_descriptor():
    gc.collect()
    before = len(os.listdir("/dev/fd"))
    page = MeshcatPage()
    port, process = page.port(), page._gateway._process
    assert process.poll() is None
    del page
    assert process.returncode == 0
    assert len(os.listdir("/dev/fd")) == before
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), 1.0)


def frame(kind, path, **more):
    return msgpack.packb({"type": kind, "path": path, **more})


def test_deletion_removes_only_the_path_and_its_subtree():
    cache = SceneCache()
    for path in ("/a", "/a/b", "/ab", "/c"):
        cache.add(frame("set_object", path, object={}))
        cache.add(frame("set_property", path, property="color", value=[1, 0, 0]))
        cache.add(frame("set_property", path, property="visible", value=True))
    cache.add(frame("delete", "/a"))
    remaining = [msgpack.unpackb(data) for data in cache.frames()]
    assert {message["path"] for message in remaining if message["type"] != "delete"} == {"/ab", "/c"}
    assert len(remaining) == 7
    cache.add(frame("set_object", "/a", object={}))
    order = [(message["type"], message["path"]) for message in map(msgpack.unpackb, cache.frames())]
    assert order.index(("delete", "/a")) < order.index(("set_object", "/a"))


EVENTS = [
    {"type": "slider", "name": "x", "value": 1.0},
    {"type": "button", "name": "keep"},
    {"type": "gamepad", "name": "", "gamepad": GAMEPAD},
    {"type": "gamepad", "name": "", "gamepad": {}},
]


@pytest.mark.parametrize("event", EVENTS)
def test_valid_event_is_parsed(event):
    assert parse_event(msgpack.packb(event), CONTROLS) == event


@pytest.mark.parametrize(
    "event",
    [
        {"type": "slider", "name": "keep", "value": 1.0},
        {"type": "slider", "name": "x", "value": float("nan")},
        {"type": "slider", "name": "x", "value": float("inf")},
        {"type": "slider", "name": "x", "value": True},
        {"type": "slider", "name": "x", "value": "1"},
        {"type": "slider", "name": "x"},
        {"type": "button", "name": "x"},
        {"type": "button", "name": "missing"},
        {"type": "button", "name": ["keep"]},
        {"type": ["button"], "name": "keep"},
        {"type": "camera_pose", "camera_pose": [0.0] * 16, "is_perspective": True},
        {"type": "gamepad", "name": "", "gamepad": GAMEPAD | {"index": -1}},
        {"type": "gamepad", "name": "", "gamepad": GAMEPAD | {"index": True}},
        {"type": "gamepad", "name": "", "gamepad": GAMEPAD | {"axes": [0.0] * (MAX_GAMEPAD + 1)}},
        {"type": "gamepad", "name": "", "gamepad": GAMEPAD | {"axes": [float("nan")]}},
        {"type": "gamepad", "name": "", "gamepad": GAMEPAD | {"axes": 1.0}},
        {"type": "gamepad", "name": "", "gamepad": [0]},
        {"type": "gamepad", "name": ""},
        [],
        None,
        {1: 2},
    ],
)
def test_invalid_event_is_ignored(event):
    assert parse_event(msgpack.packb(event), CONTROLS) is None


@given(st.binary(max_size=200))
def test_random_bytes_are_parsed_to_a_valid_event_or_none(message):
    event = parse_event(message, CONTROLS)
    assert event is None or event["type"] in ("slider", "button", "gamepad")


@pytest.mark.parametrize("place", ["PYTHONPATH", "user site"])
def test_page_opens_when_modules_are_outside_of_the_prefix(place, tmp_path):
    """The modules of the gateway are in a folder of PYTHONPATH, or of `pip install --user`, only."""
    folder = tmp_path / "modules"
    if place == "user site":
        version = f"python{sys.version_info.major}.{sys.version_info.minor}"
        folder = tmp_path / "lib" / version / "site-packages"
    folder.mkdir(parents=True)
    for module in meshcat_page.GATEWAY_MODULES:
        shutil.copytree(Path(find_spec(module).origin).parent, folder / module)
    rest = [entry for entry in sys.path if entry and not (Path(entry) / "msgpack").is_dir()]
    installed = [entry for entry in sys.path if (Path(entry) / "msgpack").is_dir()]
    program = (
        "import sys\n"
        f"sys.path += {installed + rest!r}\n"  # after the folder above, from which the modules are imported
        "import msgpack\n"
        f"assert msgpack.__file__.startswith({str(folder)!r})\n"
        "from guiderail.diagrams.envs.meshcat_page import GATEWAY_MODULES, MeshcatPage, _folders\n"
        f"assert _folders(GATEWAY_MODULES) == [{str(folder.resolve())!r}]\n"
        "page = MeshcatPage()\n"
        "assert page.port() > 0\n"
    )
    places = {"PYTHONPATH": str(folder)} if place == "PYTHONPATH" else {"PYTHONUSERBASE": str(tmp_path)}
    environment = {"PATH": os.environ["PATH"], "HOME": str(tmp_path), "DRAKE_ALLOW_NETWORK": "meshcat"} | places
    python = str(Path(sys._base_executable).resolve())
    ended = subprocess.run([python, "-c", program], env=environment, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 0, ended.stderr


def test_missing_module_of_the_gateway_is_named(monkeypatch):
    monkeypatch.setattr(meshcat_page, "GATEWAY_MODULES", ("msgpack", "missing_module"))
    with pytest.raises(InputError, match=r"the module missing_module is missing.*pip install missing_module"):
        open_meshcat()
