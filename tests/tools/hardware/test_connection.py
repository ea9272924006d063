"""Whoever stands in for a robot knows the task that is rehearsed."""

from contextlib import contextmanager

import gymnasium
import pytest

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.tasks.registry import TASKS, environment_id
from guiderail.tools.cli.main import main
from guiderail.tools.hardware.connection import RobotConnection

MINE = """
from guiderail.diagrams.tasks.bnc_connector import BncConnector
from guiderail.diagrams.tasks.registry import register_task


@register_task("mine/Connector")
class Mine(BncConnector):
    pass
"""


def test_a_simulated_robot_imports_what_the_run_does(tmp_path, monkeypatch):
    file, codes, served = tmp_path / "mine.py", [], []
    TASKS.get("BncConnector")  # a task that first came into a copy of the list would be gone with it
    file.write_text(MINE)

    @contextmanager
    def subprocess_tied_to_parent(code):
        codes.append(code)
        yield

    def serve(url, seconds, command_timeout, task, **more):
        served.append(type(EnvConfig.resolve(task, {}).make_task()).__name__)
        return True

    def wait(url, robot, task, say):
        serve(url, 0.0, 0.0, task)

    monkeypatch.setattr("guiderail.tools.hardware.connection.companion", subprocess_tied_to_parent)
    monkeypatch.setattr("guiderail.tools.hardware.sim_driver.serve_iiwa", serve)
    monkeypatch.setattr("guiderail.tools.hardware.safety_monitor.stand_by", wait)
    with RobotConnection(sim=True).standing_in("mine/Connector", "memq://", [str(file)]):
        pass
    try:
        for run in (
            lambda: exec(codes[0], {}),
            lambda: main(["safety-monitor", "--task", "mine/Connector", "--import", str(file)]),
        ):
            monkeypatch.setattr(TASKS, "_entries", {**TASKS._entries})
            monkeypatch.setattr("guiderail.tools.environments._IMPORTED", {})
            TASKS._entries.pop("mine/Connector", None)  # it is another process
            with pytest.raises(SystemExit) as end:
                run()
            assert end.value.code == 0
    finally:
        gymnasium.registry.pop(environment_id("mine/Connector"), None)
        TASKS._entries.pop("mine/Connector", None)
    assert served == ["Mine", "Mine"]
