"""Nobody is left behind."""

import signal
import subprocess
import sys

import pytest

SLEEPS = """
from guiderail.tools.operate.company import companion

started = companion("import time; time.sleep(60)")
"""
STANDS_IN = """
from guiderail.tools.operate.rehearsal import Other

started = Other(rehearse=True, lockstep=True).standing_in("BncConnector", "memq://")
"""
WAITS = """
with started:
    print("started", flush=True)
    input()
"""


@pytest.mark.parametrize(
    ("starts", "ends"),
    [(SLEEPS, signal.SIGTERM), (SLEEPS, signal.SIGINT), (STANDS_IN, signal.SIGKILL)],
    ids=["terminated", "interrupted", "a robot's killed"],
)
def test_a_process_goes_with_whoever_started_it_however_that_one_ends(starts, ends):
    with subprocess.Popen(
        [sys.executable, "-c", starts + WAITS], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as parent:
        assert parent.stdout.readline() == b"started\n"
        parent.send_signal(ends)
        # Both write there, so that it ends when neither is left.
        assert parent.communicate(timeout=50)[0] == b""
