"""Program that plays a robot with ROS 2 on the loopback interface, with faults of the network.

It publishes joint states and wrenches, and records the targets that it receives. A line on its standard input ends it;
it then prints the number of targets, the last one, and the controllers that it was asked to switch to, as JSON.
"""

import heapq
import json
import multiprocessing
import os
import random
import selectors
import sys
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TextIO

import numpy as np

CONFIG = """<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>30</MaxAutoParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""
PERIOD = 0.05  # period of the messages [s]
POSITIONS = np.array([0.0, 0.2, 0.0, -2.1, 0.0, 2.3, 0.0])


def use_loopback() -> None:
    """Restrict Cyclone DDS in this process, and in processes that it starts, to the loopback interface."""
    path = Path(tempfile.mkdtemp()) / "loopback.xml"
    path.write_text(CONFIG)
    os.environ["CYCLONEDDS_URI"] = path.as_uri()


class RobotProcess:
    """Process that plays the robot at an address, with faults by name; a fork, which saves seconds of imports."""

    def __init__(self, address: str, **faults: float):
        context = multiprocessing.get_context("forkserver")
        self._connection, child_end = context.Pipe()
        uri = os.environ["CYCLONEDDS_URI"]
        self._process = context.Process(target=_play_in_fork, args=(address, faults, uri, child_end), daemon=True)
        self._process.start()
        child_end.close()

    def end(self) -> dict:
        """End the process and return what it received."""
        self._connection.send(None)
        assert self._connection.poll(60)
        return self._connection.recv()

    def kill(self) -> None:
        """Kill the process."""
        self._process.kill()
        self._process.join()


def _play_in_fork(address: str, faults: dict, uri: str, connection: Connection) -> None:
    os.environ["CYCLONEDDS_URI"] = uri
    connection.send(play(address, faults, connection))


def play(address: str, faults: dict, stop: TextIO | Connection) -> dict:
    """Play the robot until `stop` can be read; return the received targets and requests."""
    from guiderail_hardware.drivers.ros2 import Ros2Address, Ros2Bus

    bus = Ros2Bus(Ros2Address.parse(address), robot_side=True)
    messages, rng = bus.messages, random.Random(0)
    names = [f"panda_joint{number}" for number in range(1, 8)][:: -1 if faults.get("reversed") else 1]
    queue: list = []
    received: dict = {"targets": 0, "last": None, "switched": [], "replies": 0}
    start, number = time.time(), 0
    selector = selectors.DefaultSelector()
    selector.register(stop, selectors.EVENT_READ)
    while not selector.select(timeout=2e-3):
        now = time.time()
        if now - start > number * PERIOD and not (faults.get("silent_after") and now - start > faults["silent_after"]):
            number += 1
            q = POSITIONS + 0.05 * np.sin(now - start)
            v = np.full(7, 0.05 * np.cos(now - start))
            order = [int(name[-1]) - 1 for name in names]
            header = messages.Header(messages.Time(int(now), int(1e9 * (now % 1.0))), "base")
            joints = messages.JointState(header, names, q[order].tolist(), v[order].tolist(), [0.0] * len(names))
            wrench = messages.WrenchStamped(header, messages.Wrench(messages.Vector3(0.0, 0.0, 5.0)))
            sent = [(bus.wrench, wrench), (bus.joints, joints)]
            for writer, message in sent:
                if rng.random() >= faults.get("loss", 0.0):
                    delay = faults.get("latency", 0.0) * (1.0 + rng.uniform(-1.0, 1.0) * faults.get("jitter", 0.0))
                    heapq.heappush(queue, (now + delay, number, id(message), writer, message))
        while queue and queue[0][0] <= now:
            *_, writer, message = heapq.heappop(queue)
            writer.write(message)
        for target in bus.take(bus.targets):
            p = target.pose.position
            received["targets"] += 1
            received["last"] = [p.x, p.y, p.z]
        for request in bus.take(bus.requests):
            received["switched"].append(list(request.activate_controllers))
            refused = faults.get("refuses", False)
            bus.responses.write(messages.SwitchControllerResponse(request.guid, request.number, not refused, "refused"))
    return received


if __name__ == "__main__":
    print(json.dumps(play(sys.argv[1], json.loads(sys.argv[2]), sys.stdin)))
