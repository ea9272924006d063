"""Rules of `oracles.system_rules` for the system that steps MuJoCo."""

from pathlib import Path

import pytest

import guiderail_mujoco.gantry
from guiderail.diagrams.tasks.bnc_connector.task import BncWorkcell
from guiderail_mujoco.station import MujocoStation
from oracles.system_rules import RULES, check_source


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_gantry_satisfies_the_rules(rule):
    rule(MujocoStation(BncWorkcell()).gantry)


def test_source_raises_input_errors():
    check_source(Path(guiderail_mujoco.gantry.__file__))
