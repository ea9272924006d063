"""One of each kind of fault on the bus; `make injections` draws hundreds."""

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
    faults.loaded(4, 120.0),
    faults.clock_jump(-3.0),
    faults.clock_jump(1e4),
    faults.lost(COMMAND, 0.015),
    faults.lost(COMMAND, 0.06),
    faults.controller_held_up(0.015),
    faults.controller_held_up(0.3),
    faults.controller_killed(0.06),
    faults.robot_killed(0.05),
    faults.robot_killed(0.1),
    faults.deputy_killed(0.1),
]


@pytest.fixture(scope="module")
def bus():
    return Bus()


@pytest.mark.parametrize("injection", INJECTIONS, ids=lambda injection: f"{injection.kind}, {injection.words}")
def test_stops_in_time_within_the_limits_and_goes_on(bus, injection):
    seen = injection.inject(bus)
    assert seen.wrong == []


def test_a_fault_that_nobody_finds_would_be_found_here(bus):
    """What must stop the arm and is borne, and the other way round, is said to be wrong."""
    borne = faults.duplicated(STATUS, 0.02)
    must = faults.Injection(borne.kind, borne.words, borne.begin, borne.end, borne.lasts, True)
    assert must.inject(bus).wrong == ["not detected"]
    stopped = faults.resized(3, 1)
    may_not = faults.Injection(stopped.kind, stopped.words, stopped.begin, stopped.end, stopped.lasts, False)
    assert may_not.inject(bus).wrong == ["stopped the arm: WRONG_SIZE"]
