"""Program that moves an arm on a circle and resumes as soon as possible after every stop; arguments: URL RATE."""

import contextlib
import sys

import numpy as np
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail_hardware.drivers.clock import WallClock, garbage_collection_disabled, set_realtime_priority
from guiderail_hardware.robot.sim_driver import START
from guiderail_hardware.station import HardwareStation
from guiderail_hardware.systems.torque_safety_limiter import ArmState


def main(url: str, rate: float) -> None:
    """Move the arm until the process is killed."""
    # The robot starts slowly on a busy machine.
    station = HardwareStation(BncWorkcell(), robot_url=url, robot_timeout=600.0)
    clock = WallClock(station.driver, station.period, rate)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    desired = station.get_desired_pose_input_port()
    desired.FixValue(context, START)
    station.start(simulator)
    set_realtime_priority()
    clock.begin()
    with garbage_collection_disabled():
        while True:
            angle = 2.0 * np.pi * context.get_time()
            offset = 0.01 * np.array([np.cos(angle), np.sin(angle)])
            desired.FixValue(context, START + [*offset, 0.0, 0.15 * np.sin(angle), 0.0, 0.0])
            if station.get_arm_state_output_port().Eval(context)[0] == ArmState.OFF:
                with contextlib.suppress(InputError):  # the fault persists
                    station.resume(context)
            clock.advance(simulator, station, 1)


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
