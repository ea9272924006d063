"""`guiderail stand-by`: brings an arm to rest where the program that commands it is gone."""

from __future__ import annotations

from collections.abc import Callable

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.hardware.lcm.driver import open_bus
from guiderail.diagrams.hardware.clock import set_realtime_priority
from guiderail.diagrams.hardware.monitor import SafetyMonitor
from guiderail.diagrams.hardware.driver import find_driver, safety_limits
from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.tasks.insertion import InsertionTask
from guiderail.models.common.errors import InputError


def stand_by(url: str, robot: str, task: str, *, say: Callable[[str], None] = print) -> None:
    """Stands by until the process is ended.

    Args:
        url: LCM's; its own default where it is empty.
        robot: which arm.
        task: whose workpiece it carries.
        say: what a person is told.

    Raises:
        InputError: for a robot, a task or a bus that there is not.
    """
    driver = find_driver(robot)
    declared = EnvConfig.resolve(task, {}).make_task()
    if not isinstance(declared, InsertionTask):
        raise InputError(f"{task} is done by no arm with a tool: name an insertion")
    plant = ArmControllerPlant(declared.workcell(), robot).plant
    lcm = open_bus(url)
    deputy = SafetyMonitor(type(driver)(lcm), plant, safety_limits(plant, driver))
    words = "" if set_realtime_priority() else "; the system serves this process as any other"
    say(f"standing by on {driver.command_channel} of {url or 'LCM'}{words}")
    before = deputy.duty
    while True:
        lcm.HandleSubscriptions(1000)
        if deputy.duty != before:
            before = deputy.duty
            say(before.name.lower())
