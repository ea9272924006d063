"""Lockstep of a station with a simulated Franka; a thread stands in for the robot, and `make fci` runs the robot."""

import socket
import threading
from contextlib import closing, contextmanager, suppress

import pytest
from hardware_doubles import ClockRecorder
from pydrake.systems.analysis import Simulator
from pydrake.systems.primitives import ConstantVectorSource

from guiderail_hardware.drivers import fci_lockstep
from guiderail_hardware.drivers.fci_lockstep import FciLockstepClock, LockstepServer

HOST, PERIOD = "127.0.0.1", 0.005


@pytest.fixture(autouse=True)
def _free_port(monkeypatch):
    with socket.create_server((HOST, 0)) as server:
        monkeypatch.setattr(fci_lockstep, "LOCKSTEP_PORT", server.getsockname()[1])


@contextmanager
def robot(lead=0.0):
    """Run a robot whose clock advances by `lead` [s] more than requested; yield the list of received requests."""
    requests, ended, time = [], threading.Event(), 7.0
    with closing(LockstepServer(HOST)) as server:

        def serve():
            nonlocal time
            while not ended.is_set():
                if (request := server.receive()) is not None:
                    requests.append(request)
                    time += request.get("advance", 0.0) + lead
                    server.answer(time)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield requests
        finally:
            ended.set()
            thread.join()


def test_station_receives_the_clock_of_the_robot():
    simulator, recorder = Simulator(ConstantVectorSource([0.0])), ClockRecorder()
    with robot(lead=0.001) as requests:
        clock = FciLockstepClock(HOST, 5.0, PERIOD)
        clock.begin()
        clock.advance(simulator, recorder, 3)
    assert simulator.get_context().get_time() == pytest.approx(3 * PERIOD)
    assert recorder.clocks == pytest.approx([0.006, 0.012, 0.018])
    assert [request["advance"] for request in requests] == [0.0, PERIOD, PERIOD, PERIOD]


def test_move_parts_sends_the_offsets_to_the_robot():
    with robot() as requests:
        FciLockstepClock(HOST, 5.0, PERIOD).move_parts([[1e-3, 2e-3], [0.0, 0.0]])
    assert requests == [{"parts": [[1e-3, 2e-3], [0.0, 0.0]]}]


@pytest.mark.parametrize(
    "line", [b"{", b"[1]", b"\xff", 5000 * b"[", b'{"advance": "1"}', b'{"advance": NaN}', b'{"parts": [[0.1, 0.0]]}']
)
def test_robot_disconnects_a_station_with_a_malformed_request(line, caplog):
    with robot() as requests:
        with socket.create_connection((HOST, fci_lockstep.LOCKSTEP_PORT), 5.0) as station:
            station.sendall(line + b"\n")
            with suppress(ConnectionResetError):
                assert station.recv(1) == b""
        FciLockstepClock(HOST, 1e10, PERIOD).move_parts([[1e-3, 2e-3], [0.0, 0.0]])
    assert len(requests) == len(caplog.records) == 1


def test_clock_advances_without_a_robot_and_follows_the_next():
    simulator, recorder = Simulator(ConstantVectorSource([0.0])), ClockRecorder()
    clock = FciLockstepClock(HOST, 5.0, PERIOD)
    clock.begin()
    clock.advance(simulator, recorder, 2)
    for _ in range(2):  # the second robot's clock starts from its own initial time
        with robot(lead=0.001):
            clock.begin()
            clock.advance(simulator, recorder, 2)
    assert recorder.clocks == pytest.approx([0.005, 0.01, 0.016, 0.022, 0.027, 0.033])


def test_clock_waits_only_once_for_a_silent_robot():
    simulator, recorder = Simulator(ConstantVectorSource([0.0])), ClockRecorder()
    with closing(LockstepServer(HOST)):
        clock = FciLockstepClock(HOST, 0.01, PERIOD)
        clock.advance(simulator, recorder, 3)
    assert recorder.clocks == pytest.approx([PERIOD, 2 * PERIOD, 3 * PERIOD])


def test_connection_is_retried_with_a_short_timeout(monkeypatch):
    timeouts = []

    def connect(address, timeout):
        timeouts.append(timeout)
        raise TimeoutError

    monkeypatch.setattr(fci_lockstep.socket, "create_connection", connect)
    clock = FciLockstepClock(HOST, 5.0, PERIOD)
    clock.begin()
    clock.advance(Simulator(ConstantVectorSource([0.0])), ClockRecorder(), 2)
    assert timeouts == [5.0, PERIOD, PERIOD]
