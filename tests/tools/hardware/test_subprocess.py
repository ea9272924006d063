"""Child processes exit with their parent."""

import signal
import subprocess
import sys

import pytest

from guiderail.tools.hardware.connection import subprocess_tied_to_parent

SLEEPS = """
from guiderail.tools.hardware.connection import subprocess_tied_to_parent

started = subprocess_tied_to_parent("import time; time.sleep(60)")
"""
SERVES = """
from guiderail.tools.hardware.connection import RobotConnection

started = RobotConnection(sim=True, synchronous=True).simulated_driver("BncConnector", "memq://")
"""
WAITS = """
with started:
    print("started", flush=True)
    input()
"""


@pytest.mark.parametrize(
    ("starts", "ends"),
    [(SLEEPS, signal.SIGTERM), (SLEEPS, signal.SIGINT), (SERVES, signal.SIGKILL)],
    ids=["terminated", "interrupted", "killed"],
)
def test_child_exits_when_its_parent_ends(starts, ends):
    with subprocess.Popen(
        [sys.executable, "-c", starts + WAITS], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as parent:
        assert parent.stdout.readline() == b"started\n"
        parent.send_signal(ends)
        # Both processes write there, so it is closed when neither is left.
        assert parent.communicate(timeout=50)[0] == b""


def test_pipe_to_the_child_is_closed():
    with subprocess_tied_to_parent("import time; time.sleep(60)") as process:
        assert process.poll() is None
    assert process.poll() is not None
    assert process.stdin.closed
