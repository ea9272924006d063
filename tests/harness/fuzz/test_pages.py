"""Random messages to a page: no crash, no action without the token, and the action that an independent reader finds."""

import math
import time

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.geometry import Meshcat
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from fuzz.changes import changed_trees, edited, edits
from fuzz.tally import COUNTS
from guiderail.diagrams.envs.meshcat_page import MeshcatPage

TIMEOUT = 30.0  # until a message has been handled [s]
FRAMES = 20  # messages of an example; one connection each
EVENTS = [
    {"type": "slider", "name": "x", "value": 1.0},
    {"type": "button", "name": "keep"},
    {"type": "gamepad", "name": "", "gamepad": {"index": 0, "button_values": [0.5, 1], "axes": [0.25, -1.0]}},
    {"type": "camera_pose", "camera_pose": [0.0] * 16, "is_perspective": True},
]


def packed(tree):
    try:
        return msgpack.packb(tree)
    except (ValueError, TypeError, OverflowError):  # an integer of 400 digits
        return b"\xc1"


TREES = changed_trees(EVENTS).map(packed)
MESSAGES = (
    st.binary(max_size=64)
    | TREES
    | st.tuples(TREES, edits()).map(lambda pair: edited(*pair))
    | st.sampled_from([packed(event) for event in EVENTS] + [b"\xc1", b"\xdf\xff\xff\xff\xff", b"\x91" * 3000])
)


PAGES = []  # Meshcat must not be deleted by the garbage collector in the thread of a client


@pytest.fixture(scope="module")
def page():
    PAGES.append(page := MeshcatPage())
    page.AddSlider("x", -2.0, 2.0, 0.5, 0.0)
    page.AddButton("keep")
    page.AddButton("last")
    page.Flush()
    yield page
    page.close()


def expected_inputs(messages, slider, gamepad):
    """Return clicks, slider and axes after some messages, read by the rules of the page's documentation."""
    clicks = 0
    for message in messages:
        try:
            event = msgpack.unpackb(message)
            kind, name = event["type"], event.get("name")
            if kind == "button":
                clicks += name == "keep"
            elif kind == "slider" and name == "x" and type(event["value"]) in (int, float):
                slider = slider if not math.isfinite(event["value"]) else max(-2.0, min(2.0, float(event["value"])))
            elif kind == "gamepad" and event["gamepad"] == {}:
                gamepad = []
            elif kind == "gamepad":
                index, values = event["gamepad"]["index"], event["gamepad"]["axes"] + event["gamepad"]["button_values"]
                numbers = all(type(value) in (int, float) and math.isfinite(value) for value in values)
                if type(index) is int and 0 <= index < 64 and numbers:
                    gamepad = [max(-1.0, min(1.0, float(value))) for value in event["gamepad"]["axes"]]
        except Exception:  # the page ignores every malformed message, and random bytes fail in any way
            continue
    return clicks, slider, gamepad


def send(page, messages, **changed):
    """Send messages on a connection, and wait until they have been handled."""
    last = page.GetButtonClicks("last")
    allowed = {"uri": page.ws_url(), "origin": f"http://localhost:{page.port()}"}
    with connect(**(allowed | changed), compression=None, proxy=None) as one:
        for message in messages:
            one.send(message)
        one.send(msgpack.packb({"type": "button", "name": "last"}))
        until = time.monotonic() + TIMEOUT
        while page.GetButtonClicks("last") == last:
            assert time.monotonic() < until, "the page does not answer"
            time.sleep(0.001)
        return list(page.GetGamepad().axes)


@given(st.lists(MESSAGES, min_size=1, max_size=FRAMES))
def test_page_with_the_token(page, messages):
    COUNTS["page, message with the token", "inputs"] += len(messages)
    slider, clicks = page.GetSliderValue("x"), page.GetButtonClicks("keep")
    new_clicks, slider, gamepad = expected_inputs(messages, slider, [])
    axes = send(page, messages)
    assert (page.GetButtonClicks("keep") - clicks, page.GetSliderValue("x"), axes) == (new_clicks, slider, gamepad)
    COUNTS["page, message with the token", "accepted"] += len(messages)


@given(st.lists(MESSAGES, min_size=1, max_size=FRAMES), st.data())
def test_page_without_the_token(page, messages, data):
    COUNTS["page, message without the token", "inputs"] += len(messages)
    token = data.draw(
        st.sampled_from(["", "/", "x", page._gateway.token[:-1]]) | st.text("abcXYZ019-_./%", max_size=40)
    )
    path = data.draw(st.sampled_from(["/", "", "/index.html", "?", "//"]))
    before = page.GetSliderValue("x"), page.GetButtonClicks("keep"), page.GetButtonClicks("last")
    with pytest.raises(InvalidStatus):
        send(page, messages, uri=f"ws://127.0.0.1:{page.port()}/{token}{path}")
    assert (page.GetSliderValue("x"), page.GetButtonClicks("keep"), page.GetButtonClicks("last")) == before
    assert Meshcat.GetNumActiveConnections(page) == 1, "the gateway"
    COUNTS["page, message without the token", "refused"] += len(messages)
