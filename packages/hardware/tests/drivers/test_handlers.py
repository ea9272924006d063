"""Clocks and servers refuse to run where message handlers would be called without the interpreter's lock."""

import pytest
from pydrake.lcm import DrakeLcm

from guiderail.models.common.errors import InputError
from guiderail_hardware.drivers import lcm as lcm_driver
from guiderail_hardware.drivers.clock import WallClock
from guiderail_hardware.drivers.lcm import IiwaDriver
from guiderail_hardware.drivers.lcm_simulated import LockstepClock, serve_in_lockstep, serve_in_real_time


def test_clocks_raise_when_message_handlers_are_unsafe(monkeypatch):
    monkeypatch.setattr(lcm_driver, "handlers_are_safe", lambda: False)
    lcm = DrakeLcm("memq://")
    driver = IiwaDriver(lcm)
    for start in (
        lambda: WallClock(driver),
        lambda: LockstepClock(driver, 0.01),
        lambda: serve_in_real_time(None, 0.0, lambda: None),
        lambda: serve_in_lockstep(None, lcm, lcm, 0.0, 0.0),
    ):
        with pytest.raises(InputError, match="interpreter's lock"):
            start()
