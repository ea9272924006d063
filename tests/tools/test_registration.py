"""Registries refuse invalid entries with a message of one sentence."""

import pytest
from pydantic.dataclasses import dataclass

import guiderail
from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.guidance.registry import GUIDANCE, default_guidance, register_guidance
from guiderail.diagrams.stations.registry import STATIONS, register_station
from guiderail.diagrams.stations.station import Station
from guiderail.diagrams.tasks.registry import TASKS, register_task
from guiderail.models.common.errors import InputError
from guiderail.models.primitives.kernels import KERNELS, register_kernel
from guiderail.models.robots.robot import register_end_effector, register_robot
from guiderail.tools.learning.learner import LEARNERS, register_learner
from guiderail_hardware.drivers.driver import DRIVERS, Driver, register_driver


class IncompleteDriver(Driver):
    def read(self):
        return None


def build(*arguments, **options):
    """Return None instead of an object."""


def make_class(config):
    return type("LabLearner", (), {"Config": config, "__init__": build})


def add_station(builder=build):
    register_station("lab", workcell_kind="plane")(builder)


@dataclass
class UnrelatedConfig:
    algorithm: str = "lab"


@pytest.mark.parametrize(
    ("register", "message"),
    [
        (lambda: register_kernel("lab", 3), "'lab' is registered with a function or a class, not with 3"),
        (lambda: register_driver("lab", 3), "registered with a subclass of Driver, not with 3"),
        (lambda: register_driver("lab", IncompleteDriver), "the class IncompleteDriver lacks write"),
        (lambda: GUIDANCE.register("lab", build), "'lab' is a GuidanceKind, which a decorator makes, not <function"),
        (lambda: STATIONS.register("lab", build), "'lab' is a StationKind, which a decorator makes, not <function"),
        (lambda: register_task("lab")(3), "registered with a subclass of Task, not with 3"),
        (lambda: register_robot(3), "a robot is registered as a Robot object, not 3"),
        (lambda: register_end_effector(3), "an end effector is registered as an EndEffector object, not 3"),
        (lambda: register_learner("lab", make_class(UnrelatedConfig)), "Config of lab must be a pydantic dataclass"),
    ],
)
def test_registration_refuses_an_invalid_entry(register, message):
    with pytest.raises(InputError, match=message):
        register()
    for registry in (KERNELS, DRIVERS, GUIDANCE, STATIONS, TASKS, LEARNERS):
        assert "lab" not in registry.names()


@pytest.fixture
def remove_entries():
    """Remove the entries that a test registers."""
    yield
    for registry in (STATIONS, GUIDANCE):
        for name in {"a", "lab"} & set(registry._entries):
            del registry._entries[name], registry._origins[name]


class NoPorts(Station):
    def __init__(self, workcell):
        super().__init__()


@pytest.mark.usefixtures("remove_entries")
def test_station_that_lacks_a_port_is_refused():
    add_station(NoPorts)
    with pytest.raises(InputError, match="station='lab' lacks the port desired_pose, command_time, pose, wrench"):
        guiderail.make_env("NarrowPassage", guidance="kgrl", station="lab")


@pytest.mark.usefixtures("remove_entries")
def test_registration_does_not_change_the_defaults():
    add_station()
    register_guidance("a")(build)
    assert EnvConfig.resolve("NarrowPassage", {}).station == "plane"
    assert default_guidance(["a", "kgrl", "none"]) == "kgrl"
