import pytest
from pydrake.lcm import DrakeLcm

from guiderail.diagrams.hardware import clock as pace
from guiderail.models.common.errors import InputError


def test_where_a_handler_would_end_the_process_nobody_listens(monkeypatch):
    monkeypatch.setattr(pace, "handlers_are_safe", lambda: False)
    lcm = DrakeLcm("memq://")
    for begin in (
        lambda: pace.WallClock(lcm, "STATUS"),
        lambda: pace.LockstepClock(lcm, 0.01, "STATUS"),
        lambda: pace.serve_in_real_time(None, None, 0.0, lambda: None),
    ):
        with pytest.raises(InputError, match="interpreter's lock"):
            begin()
