"""One fault of the bus of each kind; `make injections` injects hundreds."""

import numpy as np
import pytest
from injections import faults
from injections.bus import Bus

RNG = np.random.default_rng(0)
STATUS, COMMAND = "on_status", "on_command"
INJECTIONS = [
    faults.lost(STATUS, 0.015),
    faults.lost(STATUS, 0.06),
    faults.delayed(STATUS, 0.03),
    faults.delayed(STATUS, 0.05),
    faults.duplicated(STATUS, 0.02),
    faults.reordered(STATUS, 3),
    faults.not_finite("joint_velocity_estimated", [2], np.nan, 3),
    faults.resized(3, 2),
    faults.garbage(RNG, 2),
    faults.jumped("joint_velocity_estimated", 5, 5.0, 8),
    faults.external_load(4, 120.0),
    faults.clock_jump(-3.0),
    faults.clock_jump(1e4),
    faults.lost(COMMAND, 0.015),
    faults.lost(COMMAND, 0.06),
    faults.controller_paused(0.015),
    faults.controller_paused(0.3),
    faults.controller_killed(0.06),
    faults.robot_killed(0.05),
    faults.robot_killed(0.1),
    faults.monitor_killed(0.1),
]


@pytest.fixture(scope="module")
def bus():
    return Bus()


@pytest.mark.parametrize("injection", INJECTIONS, ids=lambda injection: f"{injection.kind}, {injection.description}")
def test_station_stops_in_time_and_resumes(bus, injection):
    observation = injection.inject(bus)
    assert observation.failures == []


def test_injection_reports_a_missed_or_needless_stop(bus):
    tolerated = faults.duplicated(STATUS, 0.02)
    must = faults.Injection(
        tolerated.kind, tolerated.description, tolerated.begin, tolerated.end, tolerated.duration, True
    )
    assert must.inject(bus).failures == ["not detected"]
    stopped = faults.resized(3, 1)
    may_not = faults.Injection(stopped.kind, stopped.description, stopped.begin, stopped.end, stopped.duration, False)
    assert may_not.inject(bus).failures == ["stopped the arm: WRONG_SIZE"]
