"""The system of this distribution satisfies the rules of the core's systems."""

from pathlib import Path

from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail_mujoco import gantry
from guiderail_mujoco.station import MujocoStation
from oracles.systems import check_source, check_system, system_names

FILE = Path(gantry.__file__)


def test_gantry_declares_and_documents_ports_and_prerequisites():
    (name,) = system_names(FILE)
    system = MujocoStation(BncWorkcell()).gantry
    assert type(system).__name__ == name
    check_system(system)


def test_source_gives_prerequisites_and_raises_input_errors():
    check_source(FILE)
