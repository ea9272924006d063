"""Drivers that fail while a skill is executed: the arm is brought to rest, and the outcome names the exception."""

import numpy as np
import pytest
from hardware_doubles import max_joint_speed, unplugged

from guiderail.models.common.errors import InputError
from guiderail.systems.policy_system import PolicyError
from guiderail_hardware.models.joint_status import Fault, JointStatus
from guiderail_hardware.robot import preflight


def scalar_status():
    return JointStatus(1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("step", "method", "replacement", "fault", "reason"),
    [  # in step 95 during the approach, in step 130 during the skill
        (95, "read", unplugged, Fault.MALFORMED, "read raised OSError: cable unplugged"),
        (130, "receive", unplugged, Fault.MALFORMED, "receive raised OSError: cable unplugged"),
        (95, "read", scalar_status, Fault.WRONG_SIZE, "wrong number of joints"),
        (130, "read", lambda: None, Fault.NO_STATUS, "no status message"),
    ],
)
def test_arm_rests_when_the_driver_fails(make_executor, step, method, replacement, fault, reason):
    executor, clock = make_executor()
    clock.happens[step] = lambda: setattr(executor._station.driver, method, replacement)
    outcome = executor.run(print)
    assert (outcome.fault, outcome.exit_code) == (fault, 1)
    assert reason in outcome.description
    assert (outcome.steps > 0) == (step == 130)
    assert max_joint_speed(clock) < 0.02
    assert clock.step >= step + 40  # the station continues until the arm is at rest


@pytest.mark.parametrize("method", ["read", "receive"])
def test_arm_rests_when_driver_and_policy_fail(make_executor, method):
    """After the skill has failed, the executor's station takes over without waiting for the driver."""
    requests = []

    def act(observation):
        requests.append(clock.step)
        if len(requests) < 3:
            return np.zeros(2)
        setattr(executor._station.driver, method, unplugged if method == "receive" else lambda: None)
        return np.full(2, np.nan)

    executor, clock = make_executor(policy=act, num_steps=20)
    with pytest.raises(PolicyError):
        executor.run(print)
    assert clock.step >= requests[-1] + 40
    assert max_joint_speed(clock) < 0.02


def test_skill_ends_when_the_driver_fails_at_its_start(make_executor, monkeypatch):
    executor, clock = make_executor()
    driver, execute = executor._station.driver, executor._execute

    def execute_without_statuses():
        driver.read = lambda: None
        return execute()

    monkeypatch.setattr(executor, "_execute", execute_without_statuses)
    outcome = executor.run(print)
    assert (outcome.fault, outcome.exit_code, outcome.steps) == (Fault.NO_STATUS, 1, 1)
    assert max_joint_speed(clock) < 0.02


def test_failed_commands_are_reported_and_retried(make_executor):
    executor, clock = make_executor()
    driver, attempts = executor._station.driver, []

    def write(torque, time):
        attempts.append(clock.step)
        unplugged()

    clock.happens[95] = lambda: setattr(driver, "write", write)
    outcome = executor.run(print)
    assert (outcome.fault, outcome.exit_code) == (Fault.COMMAND_FAILED, 1)
    assert outcome.description.startswith(
        "a command could not be sent to the robot (write raised OSError: cable unplug"
    )
    assert "commands that bring the arm to rest could not be sent" in outcome.description
    assert len(attempts) > 100


@pytest.mark.parametrize("failures", [1, 60])
def test_completed_skill_fails_when_the_arm_cannot_be_stopped(make_executor, monkeypatch, failures):
    executor, clock = make_executor()
    driver, rest, attempts = executor._station.driver, executor._rest, []

    def write(torque, time):
        attempts.append(time)
        if len(attempts) == failures:
            del driver.write
        unplugged()

    def rest_without_commands():
        driver.write = write
        return rest()

    monkeypatch.setattr(executor, "_rest", rest_without_commands)
    outcome = executor.run(print)
    assert (outcome.fault, outcome.exit_code, outcome.steps) == (Fault.COMMAND_FAILED, 1, 10)
    failure = f"{failures} commands that bring the arm to rest could not be sent: write raised OSError: cable unplugged"
    assert outcome.description == f"executed to its end; {failure}"
    assert max_joint_speed(clock) < 0.01


def test_first_exception_is_raised_when_commands_fail_as_well(make_executor):
    executor, clock = make_executor()
    messages = []

    def interrupt(context):
        executor._station.driver.write = unplugged
        raise KeyboardInterrupt

    clock.happens[95] = lambda: executor._simulator.set_monitor(interrupt)
    with pytest.raises(KeyboardInterrupt):
        executor.run(messages.append)
    assert "commands that bring the arm to rest could not be sent: write raised OSError" in messages[-1]


def test_checks_raise_when_the_driver_fails(make_executor, monkeypatch):
    executor, _ = make_executor()
    driver, commands = executor._station.driver, []
    driver.write = lambda *command: commands.append(command)
    for method, replacement, message in (
        ("read", unplugged, "no status can be read from the driver iiwa: read raised OSError: cable unplugged"),
        ("receive", unplugged, "no status can be read from the driver iiwa: receive raised OSError"),
        ("read", scalar_status, "stays where it is: a status message has the wrong number of joints: check the driver"),
        ("read", lambda: "status", "stays where it is: .* cannot be decoded: check the driver iiwa"),
        ("check_setup", unplugged, "the driver iiwa failed: check_setup raised OSError: cable unplugged"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(driver, method, replacement)
            with pytest.raises(InputError, match=message):
                executor.preflight.repeat()
        assert commands == []
    executor.preflight.repeat()  # the driver answers again


def test_checks_raise_when_statuses_become_malformed(make_executor, monkeypatch):
    executor, clock = make_executor()
    driver, advance = executor._station.driver, clock.advance

    def fail_then_advance(simulator, station, steps):
        if steps == preflight.NUM_STATUSES:
            driver.read = unplugged
        advance(simulator, station, steps)

    monkeypatch.setattr(clock, "advance", fail_then_advance)
    with pytest.raises(InputError, match="read raised OSError"):
        executor.preflight.repeat()
