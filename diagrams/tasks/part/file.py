"""A task folder's `task.yaml`: every number of a task made of two meshes, in one file that a person reads and edits."""

from __future__ import annotations

import hashlib
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import Field, ValidationInfo, field_validator

from guiderail.diagrams.envs.options import Number, Numbers, Options, validate_options
from guiderail.diagrams.stations.station import ContactOptions
from guiderail.models.common.errors import InputError
from guiderail.models.common.files import write_atomically
from guiderail.models.common.poses import POSE_SIZE
from guiderail.models.common.registry import did_you_mean
from guiderail.models.common.units import DEGREE, MM
from guiderail.models.common.yaml import load_yaml
from guiderail.models.objects.insertion import COLLISION_FORCE, REPEATABILITY_STD
from guiderail.models.parts.symmetry import SYMMETRIES
from guiderail.models.primitives import LinearConstraints

FILE_NAME = "task.yaml"
FILE_FORMAT = "guiderail task 1"
NAMESPACE = "parts"
_LARGEST = float(np.finfo(float).max)


class Piece(Options):
    """A mesh that touches."""

    file: str = Field(description="OBJ beside this file, in the target frame [m]")
    modulus: Number | None = Field(None, gt=0, description="[Pa] of a compliant convex mesh; none is rigid")
    friction: Number = Field(0.2, ge=0, le=2, description="of the surface, static and dynamic")
    # What is pressed in a millionth of a metre too deep within a step would otherwise be thrown out by it: with 100 s/m
    # nothing leaves a contact faster than 10 mm/s.
    dissipation: Number = Field(100.0, ge=0, description="Hunt and Crossley's [s/m]")


class PartModel(Options):
    """Of the plug or the socket."""

    source: str = Field("", description="the file that it was made of")
    visual: str = Field(description="OBJ that is seen, in the target frame [m]")
    mass: Number = Field(gt=0, description="[kg]")
    centre: Numbers = Field(min_length=3, max_length=3, description="of mass, in the target frame [m]")
    gyration: Number = Field(gt=0, description="radius of gyration [m]")
    pieces: tuple[Piece, ...] = Field(min_length=1, description="what touches")


class MotionNumbers(Options):
    """How the plug goes in along z of the target frame."""

    travel: Number = Field(gt=0, le=0.5, description="height of the start above the target [m]")
    rim: Number = Field(gt=0, le=0.5, description="height at which the plug stands on the rim [m]")
    turn: Number = Field(0.0, ge=-180, le=180, description="about z, at the bottom [degrees]")
    push: Number = Field(4.0 * MM, ge=0, le=30 * MM, description="commanded below the target while it goes in [m]")
    press: Number = Field(2.5 * MM, ge=0, le=10 * MM, description="commanded below the rim while it searches [m]")


class Tolerance(Options):
    """Success by pose: how far from the target the plug may be, in the socket."""

    height: Number = Field(0.5 * MM, gt=0, description="along z [m]")
    beside: Number = Field(1.0 * MM, gt=0, description="across it [m]")
    turn: Number = Field(4.0, gt=0, description="about z [degrees]")
    steps: int = Field(3, ge=1, description="control steps for which it must hold")


class Bounds(Options):
    """Bounds of every command, [x y z Rz Ry Rx]; one list for all steps, or one for each."""

    lower: tuple[Any, ...]
    upper: tuple[Any, ...]
    phases: tuple[Number, ...] | None = Field(
        None, min_length=1, validate_default=True, description="where in the motion each list begins to hold, from 0 on"
    )

    @field_validator("lower", "upper")
    @classmethod
    def _are_numbers(cls, value: tuple[Any, ...]) -> tuple[Any, ...]:
        rows = value if value and isinstance(value[0], list | tuple) else (value,)
        if not all(_is_row(row) for row in rows):
            raise ValueError("bounds are six finite numbers each, [x y z Rz Ry Rx], null where there is none")
        return value

    @field_validator("phases")
    @classmethod
    def _fit(cls, phases: tuple[float, ...] | None, others: ValidationInfo) -> tuple[float, ...] | None:
        if not {"lower", "upper"} <= others.data.keys():
            return phases  # what is wrong with those is said of them
        lower, upper = _filled(others.data["lower"], -np.inf), _filled(others.data["upper"], np.inf)
        if lower.shape != upper.shape or lower.shape[:-1] != (() if phases is None else (len(phases),)):
            raise ValueError("bounds that change need phases, and a list of lower and of upper ones for each")
        if phases is not None and (phases[0] != 0.0 or any(np.diff([*phases, 1.0]) <= 0.0)):
            raise ValueError("phases begin at 0, increase, and are below 1")
        for bound in (np.isfinite(lower), np.isfinite(upper)):
            if phases is not None and (bound.any(axis=0) != bound.all(axis=0)).any():
                raise ValueError("an output is bounded in every phase or in none")
        return phases

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper, each (6,) or one row a phase (K, 6), infinite where there is none."""
        return _filled(self.lower, -np.inf), _filled(self.upper, np.inf)

    def constraints(self, num_steps: int) -> LinearConstraints:
        """G y ≥ c: the same at each of N steps, or those of the phase that a step is in."""
        lower, upper = self.arrays()
        if self.phases is None:
            return LinearConstraints.box(lower, upper)
        phase = np.searchsorted(self.phases, np.linspace(0.0, 1.0, num_steps), side="right") - 1
        return LinearConstraints.box(lower[phase], upper[phase])


def _is_row(row: Any) -> bool:
    # Asked this way round, what is no number is none either, and so is one that no double holds.
    return (
        isinstance(row, list | tuple)
        and len(row) == POSE_SIZE
        and all(one is None or (type(one) in (int, float) and abs(one) <= _LARGEST) for one in row)
    )


def _filled(rows: tuple[Any, ...], missing: float) -> np.ndarray:
    return np.array(_replaced(rows, missing), dtype=float)


def _replaced(rows: Any, missing: float) -> Any:
    if isinstance(rows, list | tuple):
        return [_replaced(one, missing) for one in rows]
    return missing if rows is None else rows


class Shown(Options):
    """Demonstrations in the folder."""

    file: str = Field("demonstrations.npz", description=".npz or .csv, poses in the target frame")
    components: int | None = Field(None, ge=1, description="of their mixture; by information criterion unless given")
    floor: Numbers = Field(
        REPEATABILITY_STD,
        min_length=6,
        max_length=6,
        description="standard deviation that a hand has anyway [m], [rad]",
    )


class Recommended(Options):
    """How it is learned where nobody says otherwise."""

    environment: dict[str, Any] = Field(
        {
            "fixture_offset": "per_episode",
            "offset_range": (1.5 * MM, 2.0 * MM),  # as far off as a straight insertion must fail, and as bounds allow
            "observation": "center_of_pressure",
            "reward": "aligned",
            "action_repeat": 5,
        },
        description="options of the environment",
    )
    learner: dict[str, Any] = Field(
        {"algorithm": "tqc", "preset": "tqc_contact", "settings": {"symmetry": "near"}},
        description="algorithm, preset, and settings in place of the preset's",
    )


class PartTaskFile(Options):
    """What a task folder says."""

    format: str = FILE_FORMAT
    name: str = Field(pattern=r"^[\w:-]+/[\w:.-]+$", description="what the task is called")
    plug: PartModel
    socket: PartModel
    place: Numbers = Field((0.55, 0.0, 0.15), min_length=3, max_length=3, description="of the target in the world [m]")
    scenario: tuple[str, ...] = Field((), description="Drake model directives (.yaml) of what else stands there")
    motion: MotionNumbers
    tolerance: Tolerance = Tolerance.model_validate({})
    bounds: Bounds = Bounds.model_validate({"lower": (-2e-3, -2e-3, *[None] * 4), "upper": (2e-3, 2e-3, *[None] * 4)})
    force_limit: Number = Field(COLLISION_FORCE, ge=1, le=60, description="more than that ends an episode [N]")
    time_step: Number | None = Field(None, gt=0, description="of the simulation [s]; its own unless given")
    stiction_tolerance: Number = Field(1e-5, gt=0, description="how fast a contact that sticks may creep [m/s]")
    demonstrations: Shown = Shown.model_validate({})
    action_dims: tuple[int, ...] | None = Field((0, 1), description="outputs that a policy moves")
    sides: tuple[str, ...] = Field((), description="from which the parts look the same: see models/parts/sides.py")
    rim_sides: tuple[str, ...] = Field((), description="from which a plug on the rim feels nearly the same")
    recommended: Recommended = Recommended.model_validate({})
    measured: dict[str, Any] = Field({}, description="what onboarding measured; nothing reads it")

    @field_validator("time_step")
    @classmethod
    def _is_a_time_step(cls, value: float | None) -> float | None:
        return ContactOptions(time_step=value).time_step

    @field_validator("sides", "rim_sides")
    @classmethod
    def _are_sides(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for name in value:
            if name not in SYMMETRIES:
                raise ValueError(f"there is no side {name!r}: {did_you_mean(name, SYMMETRIES)}")
        return value

    @property
    def files(self) -> tuple[str, ...]:
        """The files that it names, beside it."""
        models = (self.plug, self.socket)
        meshes = [*(model.visual for model in models), *(piece.file for model in models for piece in model.pieces)]
        return (*meshes, self.demonstrations.file, *self.scenario)

    @cached_property
    def turn(self) -> float:
        """The turn at the bottom [rad]."""
        return self.motion.turn * DEGREE


def read_task_file(folder: Path) -> PartTaskFile:
    """The task of a folder.

    Raises:
        InputError: if it is none, something in it makes no sense, or a file that it names is missing.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        raise InputError(f"{folder} is no task: it has no {FILE_NAME}; guiderail onboard makes one")
    data = load_yaml(path, "task")
    if not isinstance(data, dict) or data.get("format") != FILE_FORMAT:
        raise InputError(f"{path} is no task: its first line must be 'format: {FILE_FORMAT}'")
    file = validate_options(PartTaskFile, data, str(path))
    for name in file.files:
        if not (folder / name).is_file():
            raise InputError(f"{path} names {name}, which is not in {folder}: put it there, or onboard the parts again")
    return file


def task_folder_digest(folder: Path) -> str:
    """A digest of what decides a task: what its file says but for what was measured, and the files that it names.

    Raises:
        InputError: as `read_task_file`.
    """
    file = read_task_file(folder)
    found = hashlib.blake2b(file.model_dump_json(exclude={"measured"}).encode(), digest_size=16)
    for name in file.files:
        found.update(hashlib.blake2b((folder / name).read_bytes()).digest())
    return found.hexdigest()


def write_task_file(folder: Path, file: PartTaskFile) -> Path:
    """Writes `task.yaml`; what it holds reads back as the same."""
    path = folder / FILE_NAME
    values = _plain(file.model_dump())
    text = yaml.safe_dump(values, sort_keys=False, width=110, default_flow_style=None)
    write_atomically(path, text.encode())
    return path


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return float(f"{value:.9g}") if isinstance(value, float) else value
