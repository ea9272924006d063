"""Double of a UR5e's controller: RTDE, dashboard and script ports, with a clock that the test advances.

The double follows Universal Robots' "Real-Time Data Exchange Guide" and "Dashboard Server" manual, and the commands of
the client's program for the controller. It emulates that program's force mode, tool center, payload, zeroing of the
force sensor and watchdog. In force mode the tool's velocity is proportional to the sum of the commanded and measured
wrenches, and a horizontal plane blocks the tool. Tests with this double show that messages arrive and have the
documented meaning and signs. They do not show how a real robot moves.
"""

from __future__ import annotations

import multiprocessing
import socket
import struct
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

CYCLE = 0.002  # control cycle of the robot [s]
REPEAT_TIME = 0.01  # wall clock time after which the newest values are sent again [s]
DAMPING = np.array([200.0] * 3 + [5.0] * 3)  # damping of the emulated force mode [Ns/m, Nms/rad]
PLANE_STIFFNESS = 2e4  # stiffness of the plane that blocks the tool [N/m]

# Published parameters d [m], a [m], alpha [rad] of a UR5e.
DENAVIT_HARTENBERG = (
    (0.1625, 0.0, np.pi / 2),
    (0.0, -0.425, 0.0),
    (0.0, -0.3922, 0.0),
    (0.1333, 0.0, np.pi / 2),
    (0.0997, 0.0, -np.pi / 2),
    (0.0996, 0.0, 0.0),
)

FORCE_MODE, END_FORCE_MODE, ZERO_SENSOR, SET_TCP, WATCHDOG, SET_PAYLOAD, STOP_SCRIPT = 6, 7, 8, 29, 35, 65, 255
READY, DONE = 1, 2  # values of the state register of the client's program
PROTECTIVE_STOP_BIT, EMERGENCY_STOP_BIT = 2, 7  # bits of the safety status

FORMATS = {"DOUBLE": "d", "INT32": "i", "UINT32": "I", "UINT8": "B", "VECTOR6D": "6d", "VECTOR3D": "3d", "BOOL": "?"}
TYPES = {
    "timestamp": "DOUBLE",
    "actual_q": "VECTOR6D",
    "actual_qd": "VECTOR6D",
    "actual_TCP_pose": "VECTOR6D",
    "actual_TCP_force": "VECTOR6D",
    "robot_status_bits": "UINT32",
    "safety_status_bits": "UINT32",
    "runtime_state": "UINT32",
    "external_force_torque": "VECTOR6D",
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
}


def type_of(name: str) -> str:
    """Return the RTDE type of a field."""
    if name in TYPES:
        return TYPES[name]
    if "_int_register" in name:
        return "INT32"
    if "_double_register" in name:
        return "DOUBLE"
    return "UINT8" if name.startswith(("standard_", "configurable_", "tool_")) else "DOUBLE"


class RtdeServer:
    """Simulated controller that listens at a loopback address.

    Args:
        host: Address to listen at, within 127.0.0.0/8.
        positions: Initial joint positions, (6,) [rad].

    Attributes:
        plane: Height of the plane that blocks the tool, in the controller's base [m].
        bias: Offset of the force sensor, (6,) [N, Nm]. Zeroing the sensor sets it to the negative contact wrench.
        calibration: Offset of the tool center from its position by the published parameters, (3,) [m].
    """

    def __init__(self, host: str, positions: np.ndarray):
        self.host, self._start, self.time, self.num_inputs = host, np.array(positions, float), 100.0, 0
        self.registers: dict[str, float] = {}
        self.reset()
        self.is_running = False
        self._clients: list[tuple[socket.socket, list[str]]] = []
        self._lock, self._changed = threading.RLock(), threading.Condition()

    def listen(self) -> None:
        """Serve the dashboard, script and RTDE ports."""
        handlers = {
            29999: self._serve_dashboard,
            30002: self._serve_script,
            30003: self._serve_script,
            30004: self._serve_rtde,
        }
        for port, handler in handlers.items():
            listener = socket.create_server((self.host, port))
            threading.Thread(target=self._accept, args=(listener, handler), daemon=True).start()
        threading.Thread(target=self._repeat, daemon=True).start()

    def reset(self) -> None:
        """Reset to the initial posture, with the program running and without a command."""
        self.positions, self.velocities, self.plane = self._start.copy(), np.zeros(6), -np.inf
        self.is_running, self.watchdog, self._last_input = True, 0.0, self.time
        self.safety_bits, self.bias, self.commands = 1, np.zeros(6), []
        self.wrench = self.speed_limits = self.task_frame = None
        self.tcp, self.payload, self.calibration = np.zeros(6), np.zeros(10), np.zeros(3)
        self.registers["output_int_register_0"] = READY

    def advance(self, seconds: float) -> None:
        """Simulate the robot for `seconds` [s], and send its state."""
        with self._lock:
            for _ in range(round(seconds / CYCLE)):
                self._step()
        self._send()

    def wait_for_input(self, number: int) -> None:
        """Wait until `number` input messages have arrived."""
        with self._changed:
            assert self._changed.wait_for(lambda: self.num_inputs >= number, 10.0)

    def pose(self) -> np.ndarray:
        """Return the tool center in the controller's base, (6,): position [m] and rotation vector [rad]."""
        X = _frames(self.positions, self.tcp)[-1]
        return np.concatenate([X[:3, 3] + self.calibration, Rotation.from_matrix(X[:3, :3]).as_rotvec()])

    def jacobian(self) -> np.ndarray:
        """Return the Jacobian of the tool center in the axes of the controller's base, (6, 6), linear part first."""
        *frames, _, tool = _frames(self.positions, self.tcp)
        axes = [X[:3, 2] for X in frames]
        return np.array([[*np.cross(z, tool[:3, 3] - X[:3, 3]), *z] for z, X in zip(axes, frames, strict=True)]).T

    def measured_force(self) -> np.ndarray:
        """Return the measured wrench on the tool in the controller's axes, (6,) [N, Nm]."""
        return self.contact_force() + self.bias

    def contact_force(self) -> np.ndarray:
        """Return the contact wrench on the tool in the controller's axes, (6,) [N, Nm]."""
        height = self.pose()[2]
        return np.array([0.0, 0.0, PLANE_STIFFNESS * max(0.0, self.plane - height), 0.0, 0.0, 0.0])

    def _step(self) -> None:
        self.time += CYCLE
        if self.watchdog and self.time - self._last_input > 1.0 / self.watchdog + 1e-9:
            self._end_program()
        twist = np.zeros(6)
        if self.is_running and self.wrench is not None and not self.safety_bits & 2**PROTECTIVE_STOP_BIT:
            desired_twist = (self.wrench + self.measured_force()) / DAMPING
            twist = np.clip(desired_twist, -self.speed_limits, self.speed_limits)
        self.velocities = np.linalg.solve(self.jacobian(), twist) if twist.any() else np.zeros(6)
        self.positions = self.positions + CYCLE * self.velocities

    def _end_program(self) -> None:
        self.is_running, self.wrench, self.watchdog = False, None, 0.0
        self.registers["output_int_register_0"] = 0

    def value(self, name: str):
        """Return the value of a field."""
        values = {
            "timestamp": self.time,
            "actual_q": self.positions,
            "actual_qd": self.velocities,
            "actual_TCP_pose": self.pose(),
            "actual_TCP_force": self.measured_force(),
            "robot_status_bits": 1 + 2 * self.is_running,
            "safety_status_bits": self.safety_bits,
            "runtime_state": 2 if self.is_running else 1,
        }
        return values.get(name, self.registers.get(name, 0))

    def _pack(self, names: list[str]) -> bytes:
        data = b"\x01"
        for name in names:
            kind, value = type_of(name), self.value(name)
            data += struct.pack(">" + FORMATS[kind], *(np.broadcast_to(value, 6) if kind == "VECTOR6D" else [value]))
        return data

    def _send(self) -> None:
        with self._lock:
            for client, names in list(self._clients):
                try:
                    client.sendall(_message(b"U", self._pack(names)))
                except OSError:
                    self._clients.remove((client, names))

    def _repeat(self) -> None:
        while True:
            time.sleep(REPEAT_TIME)
            self._send()

    def _accept(self, listener: socket.socket, handler) -> None:
        with suppress(OSError):
            while True:
                client, _ = listener.accept()
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                threading.Thread(target=handler, args=(client,), daemon=True).start()

    def _serve_dashboard(self, client: socket.socket) -> None:
        answers = {
            b"PolyscopeVersion": b"URSoftware 5.12.4.1101661 (Sep 01 2022)",
            b"is in remote control": b"true",
            b"get serial number": b"20225000000",
            b"unlock protective stop": b"Protective stop releasing",
            b"close safety popup": b"closing safety popup",
        }
        with suppress(OSError):
            client.sendall(b"Connected: Universal Robots Dashboard Server\n")
            while line := _read_line(client):
                if line == b"unlock protective stop":
                    self.safety_bits = 1
                if line == b"running":
                    answers[line] = b"Program running: " + str(self.is_running).lower().encode()
                client.sendall(answers.get(line, b"true") + b"\n")

    def _serve_script(self, client: socket.socket) -> None:
        script = b""
        with suppress(OSError):
            while chunk := client.recv(65536):
                script += chunk
                if script.rstrip().endswith(b"end") or b"run program" in script:
                    with self._lock:
                        self.is_running, script = True, b""
                        self.registers["output_int_register_0"] = READY
                    self._send()

    def _serve_rtde(self, client: socket.socket) -> None:
        with suppress(OSError):
            names: list[str] = []
            recipes: dict[int, list[str]] = {}
            while header := _read_exactly(client, 3):
                size, kind = struct.unpack(">Hc", header)
                payload = _read_exactly(client, size - 3)
                if kind == b"V":
                    client.sendall(_message(b"V", b"\x01"))
                elif kind == b"v":
                    client.sendall(_message(b"v", struct.pack(">4I", 5, 12, 4, 1101661)))
                elif kind == b"O":
                    names = _names(payload[8:])
                    client.sendall(_message(b"O", b"\x01" + ",".join(map(type_of, names)).encode()))
                elif kind == b"I":
                    fields = _names(payload)
                    number = len(recipes) + 1
                    recipes[number] = fields
                    client.sendall(_message(b"I", bytes([number]) + ",".join(map(type_of, fields)).encode()))
                elif kind == b"S":
                    client.sendall(_message(b"S", b"\x01"))
                    with self._lock:
                        self._clients.append((client, names))
                elif kind == b"P":
                    client.sendall(_message(b"P", b"\x01"))
                elif kind == b"U":
                    self._receive(recipes[payload[0]], payload)

    def _receive(self, fields: list[str], payload: bytes) -> None:
        offset = 1
        with self._lock:
            for name in fields:
                layout = ">" + FORMATS[type_of(name)]
                self.registers[name] = struct.unpack_from(layout, payload, offset)[0]
                offset += struct.calcsize(layout)
            if "input_int_register_0" in fields:
                self._last_input = self.time
                self._process(int(self.registers["input_int_register_0"]))
        self._send()
        with self._changed:
            self.num_inputs += 1
            self._changed.notify_all()

    def execute(self, command: int, doubles: Sequence[float] = (), integers: Sequence[int] = ()) -> None:
        """Write the registers of a command, and execute the command.

        Args:
            command: Number of the command.
            doubles: Values of the double registers, from register 0.
            integers: Values of the integer registers, from register 1.
        """
        self.registers |= {f"input_double_register_{i}": value for i, value in enumerate(doubles)}
        self.registers |= {f"input_int_register_{i}": value for i, value in enumerate(integers, 1)}
        self._last_input = self.time
        self._process(command)

    def _process(self, command: int) -> None:
        """Execute a command like the client's program on the controller."""
        if not self.is_running:
            return
        doubles = [float(self.registers.get(f"input_double_register_{i}", 0.0)) for i in range(24)]
        integers = [int(self.registers.get(f"input_int_register_{i}", 0)) for i in range(24)]
        state = READY if command in (0, FORCE_MODE) else DONE
        if command:
            self.commands.append(command)
        if command == FORCE_MODE:
            assert integers[1:8] == [2, 1, 1, 1, 1, 1, 1], "force mode in a fixed frame, with all axes compliant"
            self.task_frame, self.wrench, self.speed_limits = (np.array(doubles[i : i + 6]) for i in (0, 6, 12))
        elif command == END_FORCE_MODE:
            self.wrench = None
        elif command == ZERO_SENSOR:
            self.bias = -self.contact_force()
        elif command == SET_TCP:
            self.tcp = np.array(doubles[:6])
        elif command == SET_PAYLOAD:
            self.payload = np.array(doubles[:10])
        elif command == WATCHDOG:
            self.watchdog = doubles[0]
        elif command == STOP_SCRIPT:
            self._end_program()
            return
        self.registers["output_int_register_0"] = state


class DirectClient:
    """Client without a network, with the methods of ur-rtde's clients that the driver calls.

    Attributes:
        is_connected: False if the connection is lost.
    """

    def __init__(self, server: RtdeServer):
        self._server, self.is_connected = server, True

    def RTDEReceiveInterface(self, *_) -> DirectClient:
        return self

    def RTDEControlInterface(self, _) -> DirectClient:
        self._server.is_running = True
        return self

    def DashboardClient(self, _) -> Any:
        unlock = lambda: setattr(self._server, "safety_bits", 1)  # noqa: E731
        no_op = lambda: None  # noqa: E731
        return SimpleNamespace(connect=no_op, disconnect=no_op, closeSafetyPopup=no_op, unlockProtectiveStop=unlock)

    def isConnected(self) -> bool:
        return self.is_connected

    def isProgramRunning(self) -> bool:
        return self._server.is_running

    def isProtectiveStopped(self) -> bool:
        return bool(self._server.safety_bits & 2**PROTECTIVE_STOP_BIT)

    def isEmergencyStopped(self) -> bool:
        return bool(self._server.safety_bits & 2**EMERGENCY_STOP_BIT)

    def reuploadScript(self) -> bool:
        self._server.is_running = True
        return True

    def forceMode(self, frame, axes, wrench, kind, limits) -> bool:
        return self._execute(FORCE_MODE, [*frame, *wrench, *limits], [kind, *axes])

    def __getattr__(self, name: str) -> Any:
        commands = {
            "forceModeStop": END_FORCE_MODE,
            "zeroFtSensor": ZERO_SENSOR,
            "setTcp": SET_TCP,
            "setWatchdog": WATCHDOG,
            "setTargetPayload": SET_PAYLOAD,
            "kickWatchdog": 0,
        }
        if name in commands:
            return lambda *values: self._execute(commands[name], np.hstack([*values, []]))
        field = {"getTimestamp": "timestamp", "getActualQ": "actual_q", "getActualQd": "actual_qd"}.get(name)
        field = field or {"getActualTCPForce": "actual_TCP_force", "getActualTCPPose": "actual_TCP_pose"}[name]
        return lambda: self._server.value(field)

    def _execute(self, command: int, doubles: Sequence[float] = (), integers: Sequence[int] = ()) -> bool:
        if self._server.is_running:
            self._server.execute(command, doubles, integers)
        return self._server.is_running


def _frames(positions: np.ndarray, tcp: np.ndarray) -> list[np.ndarray]:
    """Return the poses of the joints, the flange and the tool center in the base, as (4, 4) matrices."""
    frames = [np.eye(4)]
    for q, (d, a, alpha) in zip(positions, DENAVIT_HARTENBERG, strict=True):
        c, s, ca, sa = np.cos(q), np.sin(q), np.cos(alpha), np.sin(alpha)
        X = np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
        frames.append(frames[-1] @ X)
    tool = np.eye(4)
    tool[:3, :3], tool[:3, 3] = Rotation.from_rotvec(tcp[3:]).as_matrix(), tcp[:3]
    return [*frames, frames[-1] @ tool]


class RtdeProcess:
    """`RtdeServer` in a child process, because some calls of the client hold the GIL.

    The attributes and methods of the server are available under the same names.
    """

    def __init__(self, host: str, positions: np.ndarray):
        context = multiprocessing.get_context("forkserver")
        connection, child_connection = context.Pipe()
        process = context.Process(target=_serve, args=(child_connection, host, positions), daemon=True)
        self.__dict__.update(_connection=connection, _process=process)
        process.start()
        assert connection.recv() == "ready"

    def _request(self, *request: Any) -> Any:
        self._connection.send(request)
        return self._connection.recv()

    def __getattr__(self, name: str) -> Any:
        if callable(getattr(RtdeServer, name, None)):
            return lambda *arguments: self._request("call", name, *arguments)
        return self._request("get", name)

    def __setattr__(self, name: str, value: Any) -> None:
        self._request("set", name, value)

    def kill(self) -> None:
        """Kill the process."""
        self._process.kill()
        self._process.join()


def _serve(connection: Connection, host: str, positions: np.ndarray) -> None:
    server = RtdeServer(host, positions)
    server.listen()
    connection.send("ready")
    with suppress(EOFError):
        while True:
            kind, name, *arguments = connection.recv()
            if kind == "call":
                connection.send(getattr(server, name)(*arguments))
            elif kind == "get":
                connection.send(getattr(server, name))
            else:
                connection.send(setattr(server, name, *arguments))


def _message(kind: bytes, payload: bytes) -> bytes:
    return struct.pack(">Hc", 3 + len(payload), kind) + payload


def _names(payload: bytes) -> list[str]:
    return [name for name in payload.decode().split(",") if name]


def _read_exactly(client: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        chunk = client.recv(size - len(data))
        if not chunk:
            return b""
        data += chunk
    return data


def _read_line(client: socket.socket) -> bytes:
    line = b""
    while not line.endswith(b"\n"):
        chunk = client.recv(1)
        if not chunk:
            return b""
        line += chunk
    return line.strip()
