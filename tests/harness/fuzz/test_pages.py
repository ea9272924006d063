"""Random messages to a page: no crash, the expected effect with the token, and no effect without the token."""

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
from fuzz.tally import COUNTS, few_inputs
from guiderail.diagrams.envs.meshcat_page import MeshcatPage

TIMEOUT = 30.0  # longest time until a message has been handled [s]
MAX_MESSAGES = 20  # largest number of messages of an example, sent on one connection
EVENTS = [
    {"type": "slider", "name": "x", "value": 1.0},
    {"type": "button", "name": "keep"},
    {"type": "gamepad", "name": "", "gamepad": {"index": 0, "button_values": [0.5, 1], "axes": [0.25, -1.0]}},
    {"type": "camera_pose", "camera_pose": [0.0] * 16, "is_perspective": True},
]


def packed(tree):
    """Return a tree as MessagePack; the invalid byte 0xC1 if the tree cannot be packed."""
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


PAGES = []  # prevents the garbage collector from deleting a Meshcat in the thread of a client


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
    """Return clicks, slider and gamepad axes after messages, by the rules in the documentation of the page."""
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
                are_valid = all(type(value) in (int, float) and math.isfinite(value) for value in values)
                if type(index) is int and 0 <= index < 64 and are_valid:
                    gamepad = [max(-1.0, min(1.0, float(value))) for value in event["gamepad"]["axes"]]
        except (ValueError, TypeError, KeyError, msgpack.UnpackException):  # the page ignores malformed messages
            continue
    return clicks, slider, gamepad


def send(page, messages, **changed):
    """Send messages on a connection, and wait until they have been handled; return the axes of the gamepad."""
    last = page.GetButtonClicks("last")
    allowed = {"uri": page.ws_url(), "origin": f"http://localhost:{page.port()}"}
    with connect(**(allowed | changed), compression=None, proxy=None) as connection:
        for message in messages:
            connection.send(message)
        connection.send(msgpack.packb({"type": "button", "name": "last"}))
        deadline = time.monotonic() + TIMEOUT
        while page.GetButtonClicks("last") == last:
            assert time.monotonic() < deadline, "the page does not handle messages"
            time.sleep(0.001)
        return list(page.GetGamepad().axes)


@few_inputs
@given(st.lists(MESSAGES, min_size=1, max_size=MAX_MESSAGES))
def test_page_applies_valid_messages_when_token_is_sent(page, messages):
    COUNTS["page, message with the token", "inputs"] += len(messages)
    slider, clicks = page.GetSliderValue("x"), page.GetButtonClicks("keep")
    new_clicks, slider, gamepad = expected_inputs(messages, slider, [])
    axes = send(page, messages)
    assert (page.GetButtonClicks("keep") - clicks, page.GetSliderValue("x"), axes) == (new_clicks, slider, gamepad)
    COUNTS["page, message with the token", "accepted"] += len(messages)


@few_inputs
@given(st.lists(MESSAGES, min_size=1, max_size=MAX_MESSAGES), st.data())
def test_page_refuses_messages_when_token_is_wrong(page, messages, data):
    COUNTS["page, message without the token", "inputs"] += len(messages)
    token = data.draw(
        st.sampled_from(["", "/", "x", page._gateway.token[:-1]]) | st.text("abcXYZ019-_./%", max_size=40)
    )
    path = data.draw(st.sampled_from(["/", "", "/index.html", "?", "//"]))
    before = page.GetSliderValue("x"), page.GetButtonClicks("keep"), page.GetButtonClicks("last")
    with pytest.raises(InvalidStatus):
        send(page, messages, uri=f"ws://127.0.0.1:{page.port()}/{token}{path}")
    assert (page.GetSliderValue("x"), page.GetButtonClicks("keep"), page.GetButtonClicks("last")) == before
    assert Meshcat.GetNumActiveConnections(page) == 1, "only the gateway is connected"
    COUNTS["page, message without the token", "refused"] += len(messages)
