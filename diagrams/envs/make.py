"""Builders of environments and of learned skills, and the pool of their diagrams."""

from __future__ import annotations

import hashlib
import inspect
import multiprocessing
from collections import defaultdict
from collections.abc import Callable, Hashable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial, update_wrapper
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AsyncVectorEnv
from pydrake.systems.framework import Diagram, DiagramBuilder, System
from threadpoolctl import threadpool_limits

from guiderail.diagrams.envs.assemble import (
    SkillDiagram,
    build_prior_knowledge,
    build_skill_diagram,
    build_task_diagram,
    make_randomize,
    turns_near_half,
)
from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.env import DiagramEnv, check_render_mode
from guiderail.diagrams.envs.task_diagram import TaskDiagram
from guiderail.diagrams.guidance.prior import PriorKnowledge
from guiderail.diagrams.guidance.registry import build_guidance
from guiderail.diagrams.stations.disturbances import disturbed
from guiderail.diagrams.stations.options import Disturbances
from guiderail.diagrams.stations.registry import StationKind
from guiderail.diagrams.stations.station import INPUTS, OUTPUTS, Station
from guiderail.diagrams.stations.wrapped_stations import ContinuousStation
from guiderail.diagrams.tasks.registry import content_digest
from guiderail.models.common.arrays import as_whole
from guiderail.models.common.errors import InputError, naming_failures
from guiderail.models.common.registry import is_sibling_module
from guiderail.models.primitives.kernels import KERNELS
from guiderail.models.robots.robot import ROBOTS


def make_station(config: EnvConfig) -> Station:
    """Build the station of a configuration, including the task's workcell.

    Raises:
        InputError: If the station lacks a port, or has a fixed control period other than the option `control_period`.
    """
    task, kind = config.declared, config.station_kind
    workcell = task.workcell()
    arguments = dict(config.parts["station"])
    takes_period = "control_period" in inspect.signature(kind.build).parameters
    if config.control_period is not None and takes_period:
        arguments["control_period"] = config.period
    build, disturbances = _checked_builder(kind, workcell, arguments), config.parts["disturbances"]
    if isinstance(disturbances, Disturbances):
        station = disturbed(build, disturbances, kind.is_simulated, kind.name, task.impedance())
    else:
        station = build()
    rounding = 1e-9 if arguments.get("time_step") else 0.0  # see `exact_periods`
    if config.control_period is not None and abs(station.nominal_period - config.period) > rounding:
        raise InputError(
            f"station={kind.name!r} has a control period of {station.nominal_period:g} s: leave control_period out, or "
            "let the station's builder take the parameter control_period"
        )
    reference = config.reference() if station.wraps_angles and kind.is_simulated else None
    if reference is not None and turns_near_half(reference.means):
        station = ContinuousStation(station, reference.means[0])
    return station


def _checked_builder(kind: StationKind, workcell: Any, arguments: Mapping[str, Any]) -> Callable[..., Station]:
    """Return a builder with its arguments bound, which raises an InputError unless the station has all ports."""
    build = partial(kind.build, workcell, **arguments)

    def checked(**more: Any) -> Station:
        station = build(**more)
        missing = [name for name in INPUTS if not station.HasInputPort(name)]
        missing += [name for name in OUTPUTS if not station.HasOutputPort(name)]
        if missing:
            raise InputError(f"station={kind.name!r} lacks the port {', '.join(missing)}: export it")
        return station

    return update_wrapper(checked, build)


def make_guidance(config: EnvConfig, station: Station) -> Diagram:
    """Build the guidance of a configuration.

    Raises:
        InputError: As `build_prior_knowledge` and `build_guidance`.
    """
    return build_guidance(config.guidance, build_prior_knowledge(config, station), config.task)


def make_prior_knowledge(task: str | EnvConfig, **options: Any) -> PriorKnowledge:
    """Return the prior knowledge that an environment's guidance is built from, such as its primitive or template.

    `task` and `options` are those of `make_env`. The station may also be a real robot.

    Raises:
        InputError: If a name is unknown, a value is out of range, or options are incompatible.
    """
    config = _config(task, options)
    return build_prior_knowledge(config, make_station(config))


def make_env(
    task: str | EnvConfig,
    *,
    render_mode: str | None = None,
    before_build: Callable[[DiagramBuilder], object] | None = None,
    **options: Any,
) -> DiagramEnv:
    """Build the environment that `gymnasium.make("guiderail/<Task>-v0", ...)` returns without its wrappers.

    Until the environment is closed, numerical libraries use one thread in this process; see `DiagramPool`.

    Args:
        task: Configuration, or name of the task, or path of a task folder.
        render_mode: None, "human" (browser view at `env.unwrapped.diagram.meshcat.web_url()`) or "rgb_array".
        before_build: Function that is called with the builder of the environment's diagram before it is built, and may
            add systems to it: loggers, visualizers, publishers. Its subsystems "station" and "guidance" have the ports.
        options: Options of the environment, if `task` is not a configuration; `guiderail list TASK` lists them.

    Raises:
        InputError: If a name is unknown, a value is out of range, options are incompatible, or the station is a real
            robot.
    """
    check_render_mode(render_mode)
    config = _config(task, options)
    if not config.station_kind.is_simulated:
        raise InputError(
            f"station={config.station!r} is a real robot, which a reset cannot move: train and evaluate in a "
            "simulation, and execute the policy by guiderail deploy"
        )
    exported = render_mode if render_mode == "rgb_array" else None
    key = None if before_build is not None else _key(config, exported)
    built = _POOL.acquire(key, lambda: _build(config, exported, before_build))
    # The hidden values of a run belong to the environment, not to the diagram.
    randomize = make_randomize(config, built.station, built.guidance, built.diagram.diagram)
    diagram = replace(built.diagram, randomize=randomize)
    release = partial(_POOL.release, key, built)
    try:
        return DiagramEnv(diagram, action_repeat=config.action_repeat, render_mode=render_mode, release=release)
    except BaseException:  # for example if the browser view finds no free port
        release()
        raise


def make_vector_env(num_envs: int = 1, **arguments: Any) -> AsyncVectorEnv:
    """Build the environment that `gymnasium.make_vec("guiderail/<Task>-v0", num_envs=..., ...)` returns.

    Each environment runs in a process of its own, which is forked from a new process: forks of this process would copy
    locks that its threads hold. The script that calls it therefore needs `if __name__ == "__main__":`.

    Args:
        num_envs: Number of environments.
        arguments: Arguments of `make_env`.

    Raises:
        InputError: As `make_env`, or if `num_envs` is not a positive whole number.
    """
    num_envs = as_whole(num_envs, "num_envs", 1)
    multiprocessing.set_forkserver_preload([__name__])  # imports the module once, not in each process
    return AsyncVectorEnv([partial(make_env, **arguments)] * num_envs, context="forkserver")


def make_skill(
    task: str | EnvConfig,
    policy: System | Callable[[np.ndarray], np.ndarray],
    *,
    render_mode: str | None = None,
    before_build: Callable[[DiagramBuilder], object] | None = None,
    **options: Any,
) -> SkillDiagram:
    """Build a learned skill as a diagram for a `Simulator`: observation → policy → guidance → station.

    Args:
        task: Configuration, or name or folder of the task that the policy was trained on.
        policy: Saved `Policy`, function from observation to action, or system with ports `observation` and `action`.
        render_mode: None, "human" (browser view) or "rgb_array" (output `rgb_image`).
        before_build: As in `make_env`.
        options: Options of the environment that the policy was trained in, if `task` is not a configuration.

    Raises:
        InputError: If a name is unknown, a value is out of range, options are incompatible, or the sizes of the
            policy's ports do not match the environment.
    """
    check_render_mode(render_mode)
    config = _config(task, options)
    station = make_station(config)
    guidance = make_guidance(config, station)
    return build_skill_diagram(config, station, guidance, policy, render_mode=render_mode, before_build=before_build)


@dataclass(frozen=True)
class BuiltDiagram:
    """Diagram of a task with its station and guidance."""

    diagram: TaskDiagram
    station: Station
    guidance: Diagram


class DiagramPool:
    """Pool of diagrams that no environment uses, by a key that is equal for equal diagrams.

    A diagram that contains a LeafSystem written in Python is never freed: C++ holds references to the system's methods,
    the methods hold the system, and no garbage collector finds this cycle. Reuse is safe because everything that
    changes during a simulation is in a context, and each environment creates its own.

    While a diagram is in use, numerical libraries use one thread in this process. The matrices are small: if other
    processes use the cores, several threads that wait for each other take eighty times as long. The number of threads
    would also change the rounding of sums. The previous limits return with the last diagram.
    """

    def __init__(self) -> None:
        self._idle: defaultdict[Hashable, list[BuiltDiagram]] = defaultdict(list)
        self._num_used = 0
        self._limits: threadpool_limits | None = None

    def acquire(self, key: Hashable | None, build: Callable[[], BuiltDiagram]) -> BuiltDiagram:
        """Return an idle diagram of the key, or build one; with the key None, always build one."""
        if self._num_used == 0:
            self._limits = threadpool_limits(1)
        self._num_used += 1
        try:
            idle = [] if key is None else self._idle[key]
            # A diagram that a user has added to another diagram cannot be simulated alone.
            idle[:] = [each for each in idle if each.diagram.diagram.GetSystemPathname().count("::") == 1]
            return idle.pop() if idle else build()
        except BaseException:
            self._return_limits()
            raise

    def release(self, key: Hashable | None, built: BuiltDiagram) -> None:
        """Take back a diagram; one without a key is dropped."""
        if key is not None:
            self._idle[key].append(built)
        self._return_limits()

    def _return_limits(self) -> None:
        self._num_used -= 1
        if self._num_used == 0 and self._limits is not None:
            self._limits.restore_original_limits()
            self._limits = None


_POOL = DiagramPool()


def _config(task: str | EnvConfig, options: dict[str, Any]) -> EnvConfig:
    if not isinstance(task, EnvConfig):
        return EnvConfig.resolve(task, options)
    if options:
        raise InputError(
            f"a configuration contains all options: give {', '.join(options)} to EnvConfig.resolve instead"
        )
    return task


def _build(
    config: EnvConfig, render_mode: str | None, before_build: Callable[[DiagramBuilder], object] | None
) -> BuiltDiagram:
    builders = type(config.declared), config.guidance_kind.build, config.station_kind.build
    with nullcontext() if all(map(_is_packaged, builders)) else naming_failures(f"building {config.task}", ImportError):
        station = make_station(config)
        guidance = make_guidance(config, station)
        diagram = build_task_diagram(config, station, guidance, render_mode=render_mode, before_build=before_build)
        return BuiltDiagram(diagram, station, guidance)


def _key(config: EnvConfig, render_mode: str | None) -> Hashable:
    """Return a key that is equal for environments with equal diagrams; None if the diagram is not shared.

    Tasks, guidance, stations, kernels and robots of other packages may read files at each construction: a robot's
    model, for example, names meshes and further models. Their diagrams are not shared, because the key does not contain
    these files. For tasks of this package, the key contains the digests of the files that options name and of the files
    in a task folder.
    """
    task, options = type(config.declared), config.options
    builders = [task, config.guidance_kind.build, config.station_kind.build]
    if "kernel" in options:
        builders.append(KERNELS.get(options["kernel"]))
    # Each construction of a diagram that is not shared takes 20 to 230 ms and 1 to 15 MB, with the shipped stations.
    is_own_robot = "robot" in options and not ROBOTS.is_packaged(options["robot"])
    if is_own_robot or not all(map(_is_packaged, builders)):
        return None
    try:
        declared = config.guidance_kind.options
        key = None if declared is None else declared.diagram_key(options)
        files = content_digest(task), *map(_digest, options.values())
        return task, config.guidance_kind, config.station_kind, key, render_mode, freeze(options), files
    except (TypeError, OSError, InputError):
        return None  # an option is not comparable, or a file that an option names or of the task folder cannot be read


def freeze(value: Any) -> tuple[str, Any]:
    """Return a hashable pair of a value's type and content, because True, 1 and 1.0 are equal.

    Raises:
        TypeError: If the value is not None, a bool, int, float or str, or a list, tuple or dict of such values.
    """
    if isinstance(value, dict):
        return "dict", tuple(sorted((name, freeze(entry)) for name, entry in value.items()))
    if isinstance(value, list | tuple):
        return "list", tuple(freeze(entry) for entry in value)
    if value is not None and type(value) not in (bool, int, float, str):
        raise TypeError
    return type(value).__name__, repr(value)


def _is_packaged(definition: Any) -> bool:
    """Return True if a class or a function is defined in this package or a sibling distribution."""
    return is_sibling_module(str(getattr(definition, "__module__", "")))


def _digest(option: Any) -> bytes | None:
    """Return the digest of the file that an option's value names; None if the value is not the path of a file."""
    if not isinstance(option, str) or not Path(option).is_file():
        return None
    with Path(option).open("rb") as file:
        return hashlib.file_digest(file, "sha256").digest()
