"""Faults of the bus and its programs, at least one of each kind; `make injections` injects hundreds."""

from dataclasses import replace

import numpy as np
import pytest
from injections import faults
from injections.bus import PERIOD, START, Bus

from guiderail_hardware.systems.torque_safety_limiter import ArmState

RNG = np.random.default_rng(0)
STATUS, COMMAND = "on_status", "on_command"
INJECTIONS = [
    faults.message_loss(STATUS, 0.015),
    faults.message_loss(STATUS, 0.06),
    faults.message_delay(STATUS, 0.05),
    faults.message_duplication(STATUS, 0.02),
    faults.message_swap(STATUS, 3),
    faults.non_finite_status("joint_velocity_estimated", [2], np.nan, 3),
    faults.resized_status(3, 2),
    faults.malformed_status(RNG, 2),
    faults.status_jump("joint_velocity_estimated", 5, 5.0, 8),
    faults.external_load(4, 120.0),
    faults.clock_jump(-3.0),
    faults.message_loss(COMMAND, 0.015),
    faults.controller_pause(0.015),
    faults.controller_pause(0.3),
    faults.controller_kill(0.06),
    faults.robot_kill(0.05),
    faults.monitor_kill(0.1),
]


@pytest.fixture(scope="module")
def bus():
    return Bus()


@pytest.mark.parametrize("injection", INJECTIONS, ids=lambda injection: f"{injection.kind}, {injection.description}")
def test_station_stops_and_resumes_as_required(bus, injection):
    observation = injection.inject(bus)
    assert observation.failures == []


def test_injection_reports_a_missed_or_needless_stop(bus):
    tolerated = faults.message_duplication(STATUS, 0.02)
    assert replace(tolerated, stops=True).inject(bus).failures == ["not detected"]
    stopping = faults.resized_status(3, 1)
    assert replace(stopping, stops=False).inject(bus).failures == ["stopped the arm: WRONG_SIZE"]


def test_contact_with_a_rim_is_no_fault(monkeypatch):
    """The plug hits the rim beside the bore, and presses with the largest force of the impedance, 40 N."""
    bus = Bus()
    begin, speed, depth = bus.step, 0.05, 0.04
    beside = np.array([0.003, 0.0, 0.0, 0.0, 0.0, 0.0])

    def desired():
        elapsed = (bus.step - begin) * PERIOD
        down = np.clip(speed * (elapsed - 0.6), 0.0, depth)
        return START + min(elapsed / 0.5, 1.0) * beside - [0.0, 0.0, down, 0.0, 0.0, 0.0]

    monkeypatch.setattr(bus, "desired", desired)
    bus.run_until_following(0.0)
    while (bus.step - begin) * PERIOD < 0.6 + depth / speed + 0.3:
        bus.step_once()
        assert not bus.is_detected, (bus.step * PERIOD, bus.fault, bus.monitor.fault)
    assert bus.arm_state == ArmState.RUNNING
    assert np.linalg.norm(bus.station.GetOutputPort("wrench").Eval(bus.simulator.get_context())[:3]) > 30.0
