"""File `task.yaml` of a task folder: all parameters of a task with two parts, which users can read and edit."""

from __future__ import annotations

import hashlib
import json
import re
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import yaml
from pydantic import Field, ValidationInfo, field_validator, model_validator

from guiderail.diagrams.envs.options import Number, Numbers, Options, TaskOptions, validate_options
from guiderail.diagrams.stations.options import CONTROL_PERIOD, ContactOptions
from guiderail.diagrams.tasks.options import (
    FORCE_LIMITS,
    REPEATABILITY_STD,
    PriorStd,
    force_limit_field,
    prior_std_field,
    reference_of_file,
)
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.files import read_bytes, write_atomically
from guiderail.models.common.registry import did_you_mean
from guiderail.models.common.transforms import DEGREE, MM, POSE_SIZE
from guiderail.models.common.yaml import MAX_SIZE, parse_content
from guiderail.models.primitives import LinearConstraints, ReferenceTrajectory
from guiderail.models.primitives.demonstrations import phases_of_steps
from guiderail_parts.geometry.assembly_check import SYMMETRIES
from guiderail_parts.geometry.demonstrator import TOUCH, plan_search, plan_straight_insertion

FILE_NAME = "task.yaml"
_FILE_NAME = re.compile(r"[\w()+ -][\w.()+ /-]*")  # path of a file in the folder; it is also written into XML
FILE_FORMAT = "guiderail task 1"
NAMESPACE = "parts"
HARD: dict[str, Any] = {
    "fixture_offset": "per_episode",
    "offset_range": (2.6 * MM, 3.0 * MM),
    "bound": 3.5 * MM,
    "force_limit": 20.0,
    "observation": "center_of_pressure",
    "action_repeat": 5,
}
"""Options of difficulty="hard" if task.yaml has none; the socket's offset exceeds most lead-in chamfers."""

AUTOMATE: dict[str, Any] = {
    "fixture_offset": "per_episode",
    "offset_shape": "square",
    "offset_range": (0.0, 2.0 * MM),
    "fixture_turn": 5.0,
    "bound": 3.5 * MM,
    "observation": "center_of_pressure",
    "action_repeat": 5,
}
"""Options of difficulty="automate": AutoMate's uncertainty, ±2 mm along x and y and ±5° about the axis."""
_LARGEST = float(np.finfo(float).max)
IN_SOCKET = 0.5 * MM  # depth below the first contact from which a plug is in the socket [m]
MAX_CLEARANCE = 500.0  # largest accepted clearance [mm], equal to the largest size of a part
# Largest bound of a command [m], [rad]: larger bounds are probably in millimeters or degrees. A command may approach
# from the side, start at the largest `travel`, and turn by 180° plus a `search_turn`.
MAX_BOUND = np.array([0.1, 0.1, 0.6, 4.0, 1.0, 1.0])


class Piece(Options):
    """Collision mesh."""

    file: str = Field(
        description="file in the task folder, in the target frame [m]: OBJ (convex if compliant), or VTK with "
        "tetrahedra (compliant)"
    )
    modulus: Number | None = Field(
        None, gt=0, description="hydroelastic modulus of a compliant mesh [Pa]; default: rigid"
    )
    friction: Number = Field(0.2, ge=0, le=2, description="friction coefficient of the surface, static and dynamic")
    # With 100 s/m, no part leaves a contact faster than 10 mm/s. With less dissipation, a contact that is a micrometer
    # too deep after a step would eject the plug.
    dissipation: Number = Field(100.0, ge=0, description="Hunt-Crossley dissipation [s/m]")


class PartModel(Options):
    """Model of the plug or the socket."""

    source: str = Field("", description="source file")
    visual: str = Field(description="OBJ file of the visual, in the target frame [m]")
    mass: Number = Field(gt=0, description="mass [kg]")
    center: Numbers = Field(min_length=3, max_length=3, description="center of mass in the target frame [m]")
    gyration: Number = Field(gt=0, description="radius of gyration [m], the same about every axis")
    pieces: tuple[Piece, ...] = Field(min_length=1, description="collision meshes")
    convex: tuple[str, ...] = Field(
        (), description="OBJ files of convex pieces, which station=mujoco needs for both parts; default: none"
    )


class MotionNumbers(Options):
    """Motion of the plug along z of the target frame."""

    travel: Number = Field(gt=0, le=0.5, description="height of the start above the target [m]")
    first_contact: Number = Field(
        gt=TOUCH, le=0.5, description="height at which a misaligned plug first touches the socket, as measured [m]"
    )
    turn: Number = Field(0.0, ge=-180, le=180, description="turn about z at the bottom [degrees]")
    advance: Number = Field(0.0, ge=0, le=0.5, description="height lost during the turn, as by a screw [m]")
    search_turn: Number = Field(
        0.0, ge=0, le=10, description="largest unknown turn of the socket, which a search must find [degrees]"
    )
    push: Number = Field(
        4.0 * MM, ge=0, le=30 * MM, description="depth of the command below the target during the insertion [m]"
    )
    press: Number = Field(
        2.5 * MM, ge=0, le=10 * MM, description="depth of the command below first_contact during a search [m]"
    )

    @field_validator("first_contact")
    @classmethod
    def _check_first_contact(cls, value: float, info: ValidationInfo) -> float:
        travel = info.data.get("travel", np.inf)
        if travel - value - TOUCH < 0.0:
            raise ValueError(
                f"first_contact must be at least {TOUCH:g} m less than travel, {travel:g} m, not {value:g} m"
            )
        return value

    @field_validator("advance")
    @classmethod
    def _check_advance(cls, value: float, info: ValidationInfo) -> float:
        if value and value >= info.data.get("first_contact", np.inf) - TOUCH:
            raise ValueError(f"the advance must be more than {TOUCH:g} m less than first_contact")
        return value

    def plan_straight_insertion(self) -> tuple[np.ndarray, np.ndarray]:
        """Return times (N,) [s] and poses (N, 6) of a straight insertion."""
        return plan_straight_insertion(self.travel, self.first_contact, self.turn * DEGREE, self.push, self.advance)

    def plan_search(self) -> tuple[np.ndarray, np.ndarray]:
        """Return times (N,) [s] and poses (N, 6) of a demonstration with a search on the rim."""
        return plan_search(self.travel, self.first_contact, self.turn * DEGREE, self.push, self.press, self.advance)


class Tolerance(Options):
    """Largest deviation of the plug from the target at success."""

    height: Number = Field(0.5 * MM, gt=0, description="along z [m]")
    lateral: Number = Field(1.0 * MM, gt=0, le=10.0 * MM, description="across z [m]")
    turn: Number = Field(4.0, gt=0, le=180, description="about z [degrees]")
    steps: int = Field(3, ge=1, description="consecutive steps that count as success, at the default control period")

    def accepts(self, plug: np.ndarray) -> bool:
        """Return True if a plug is at the target.

        `plug` is its position [m] and rotation vector [rad] in the socket, (6,).
        """
        return bool(
            abs(plug[2]) < self.height
            and np.hypot(plug[0], plug[1]) < self.lateral
            and abs(plug[5]) < self.turn * DEGREE
        )


class Bounds(Options):
    """Bounds of every command, [x y z Rz Ry Rx] in m and rad: one list for all steps, or one list for each phase."""

    lower: tuple[Any, ...]
    upper: tuple[Any, ...]
    phases: tuple[Number, ...] | None = Field(
        None,
        min_length=1,
        description="fraction of the motion from which each list applies; the first is 0",
    )

    @field_validator("lower", "upper")
    @classmethod
    def _check_rows(cls, value: tuple[Any, ...]) -> tuple[Any, ...]:
        rows = value if value and isinstance(value[0], list | tuple) else (value,)
        if not all(_is_row(row) for row in rows):
            raise ValueError("bounds are six finite numbers each, [x y z Rz Ry Rx], null for an absent bound")
        if (np.abs(_filled(rows, 0.0)) > MAX_BOUND).any():
            raise ValueError(
                f"bounds are in meters and radians, at most {MAX_BOUND[0]:g} m for x and y, {MAX_BOUND[2]:g} m for z, "
                f"{MAX_BOUND[3]:g} rad for Rz and {MAX_BOUND[4]:g} rad for Ry and Rx"
            )
        return value

    @model_validator(mode="after")
    def _check_shapes(self) -> Self:
        (lower, upper), phases = self.arrays(), self.phases
        if lower.shape != upper.shape or lower.shape[:-1] != (() if phases is None else (len(phases),)):
            raise ValueError("without phases, lower and upper are one list each; with phases, one list for each phase")
        if (lower > upper).any():
            raise ValueError("no lower bound may exceed its upper bound")
        if phases is not None and (phases[0] != 0.0 or any(np.diff([*phases, 1.0]) <= 0.0)):
            raise ValueError("phases begin at 0, increase, and are below 1")
        for bound in (np.isfinite(lower), np.isfinite(upper)):
            if phases is not None and (bound.any(axis=0) != bound.all(axis=0)).any():
                raise ValueError("an output is bounded in every phase or in none")
        return self

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """Return lower and upper bounds, (6,) or one row for each phase (K, 6); an absent bound is infinite."""
        return _filled(self.lower, -np.inf), _filled(self.upper, np.inf)

    def nearest(self, pose: np.ndarray, phase: int) -> np.ndarray:
        """Return the pose (6,) nearest to `pose` (6,) within the bounds of the phase with the index `phase`."""
        lower, upper = (np.atleast_2d(rows)[phase] for rows in self.arrays())
        return np.clip(pose, lower, upper)

    def constraints(self, num_steps: int) -> LinearConstraints:
        """Return the bounds as G y ≥ c: constant, or for each of `num_steps` steps the bounds of its phase."""
        lower, upper = self.arrays()
        if self.phases is None:
            return LinearConstraints.box(lower, upper)
        phase = phases_of_steps(self.phases, num_steps)
        return LinearConstraints.box(lower[phase], upper[phase])


def _is_row(row: Any) -> bool:
    # The comparison is also false for NaN and for integers beyond the range of doubles.
    return (
        isinstance(row, list | tuple)
        and len(row) == POSE_SIZE
        and all(entry is None or (type(entry) in (int, float) and abs(entry) <= _LARGEST) for entry in row)
    )


def _filled(rows: tuple[Any, ...], missing: float) -> np.ndarray:
    numbers = np.array(rows, dtype=float)  # None becomes NaN; all numbers are finite
    return np.where(np.isnan(numbers), missing, numbers)


class DemonstrationFile(TaskOptions):  # the base class is part of the digest that runs store
    """Demonstrations in the task folder, and the fit of their reference trajectory."""

    prior_std: PriorStd | None = prior_std_field()
    file: str = Field("demonstrations.npz", description="file .npz or .csv of poses in the target frame")
    components: int | None = Field(
        None,
        ge=1,
        description="number of components of the Gaussian mixture; default: selected by the Bayesian information "
        "criterion",
    )
    floor: Numbers = Field(
        REPEATABILITY_STD,
        min_length=6,
        max_length=6,
        description="repeatability of a demonstrator's hand, as a standard deviation [m], [rad]; its square is added "
        "to the covariance",
    )

    def reference(self, folder: Path) -> ReferenceTrajectory:
        """Return the reference trajectory of the demonstrations in a task folder, fitted once per process."""
        return reference_of_file(folder / self.file, self.components, self.floor, prior_std=self.prior_std)


class Recommended(Options):
    """Default options of environment and learner."""

    environment: dict[str, Any] = Field(
        {
            "fixture_offset": "per_episode",
            "offset_range": (1.0 * MM, 1.5 * MM),  # too large for a straight insertion
            "observation": "center_of_pressure",
            "reward": "aligned",
            "action_repeat": 5,
        },
        description="options of the environment",
    )
    learner: dict[str, Any] = Field(
        {"algorithm": "tqc", "preset": "tqc_contact", "settings": {"symmetry": "near"}},
        description="algorithm, preset, and settings that override the preset",
    )

    @field_validator("learner")
    @classmethod
    def _check_learner(cls, value: dict[str, Any]) -> dict[str, Any]:
        kinds = {"algorithm": str, "preset": str, "settings": dict}
        for key, entry in value.items():
            if key not in kinds:
                raise ValueError(f"there is no key {key!r}: {did_you_mean(key, kinds)}")
            if not isinstance(entry, kinds[key]):
                raise ValueError(f"{key} must be {'values by name' if key == 'settings' else 'a name'}")
        return value


class SearchNumbers(Options):
    """Parameters of the scripted search for a plug on the rim."""

    lever_sign: Literal[-1, 1] = Field(
        -1,
        description="1 if a misaligned plug's center of pressure lies towards the socket's axis, -1 if away from it",
    )
    contact_map: str | None = Field(
        None, description="file in the task folder with the measured contact map; default: no contact was measured"
    )
    speed: Number = Field(2.0, gt=0, le=10, description="change of the action [1/s]")
    turn_speed: Number = Field(0.5, gt=0, le=10, description="change of the action that turns the plug [1/s]")


class PartTaskFile(Options):
    """Content of `task.yaml`."""

    format: str = FILE_FORMAT
    name: str = Field(pattern=r"^[\w:-]+/[\w:.-]+$", description="name of the task")
    plug: PartModel
    socket: PartModel
    place: Numbers = Field(
        (0.55, 0.0, 0.15), min_length=3, max_length=3, description="position of the target in the world [m]"
    )
    scenario: tuple[str, ...] = Field((), description="Drake model directives (.dmd.yaml) of further objects")
    motion: MotionNumbers
    tolerance: Tolerance = Tolerance.model_validate({})
    # Beyond the default offsets, because friction holds a plug on the rim up to 1 mm behind the command.
    bounds: Bounds = Bounds.model_validate(
        {"lower": (-2.75e-3, -2.75e-3, *[None] * 4), "upper": (2.75e-3, 2.75e-3, *[None] * 4)}
    )
    force_limit: Number = force_limit_field(FORCE_LIMITS[0])
    time_step: Number | None = Field(None, gt=0, description="time step of the simulation [s]; default: the station's")
    stiction_tolerance: Number = Field(1e-5, gt=0, description="largest slip speed of a sticking contact [m/s]")
    demonstrations: DemonstrationFile = DemonstrationFile.model_validate({})
    action_dims: tuple[int, ...] | None = Field((0, 1), description="indices of the outputs that an action moves")
    sides: tuple[str, ...] = Field((), description="symmetries of both parts: see geometry/assembly_check.py")
    rim_sides: tuple[str, ...] = Field((), description="symmetries that nearly hold for a plug on the rim")
    recommended: Recommended = Recommended.model_validate({})
    search: SearchNumbers = SearchNumbers.model_validate({})
    hard: dict[str, Any] = Field(HARD, description="options of the environment with difficulty=hard")
    measured: dict[str, Any] = Field(
        {}, description="measurements of create-task, for information; only the clearance is used, in hold tests"
    )

    @field_validator("measured")
    @classmethod
    def _check_clearance(cls, value: dict[str, Any]) -> dict[str, Any]:
        clearance = value.get("clearance_mm")
        is_number = isinstance(clearance, int | float) and not isinstance(clearance, bool)
        if clearance is not None and not (is_number and 0.0 <= clearance <= MAX_CLEARANCE):
            raise ValueError(
                f"clearance_mm must be a number from 0 to {MAX_CLEARANCE:g}, or null (no walls face each other), not "
                f"{brief(clearance)}"
            )
        return value

    @field_validator("time_step")
    @classmethod
    def _check_time_step(cls, value: float | None) -> float | None:
        if value is not None and abs(CONTROL_PERIOD / value - round(CONTROL_PERIOD / value)) > 1e-6:
            raise ValueError(f"it divides the control period of {CONTROL_PERIOD:g} s, such as 0.0025")
        return ContactOptions(time_step=value).time_step

    @field_validator("tolerance")
    @classmethod
    def _check_height(cls, value: Tolerance, info: ValidationInfo) -> Tolerance:
        if "motion" in info.data and value.height >= info.data["motion"].first_contact:
            raise ValueError(f"height must be less than motion.first_contact, {info.data['motion'].first_contact:g} m")
        return value

    @field_validator("bounds")
    @classmethod
    def _check_target_is_allowed(cls, value: Bounds, info: ValidationInfo) -> Bounds:
        if not {"motion", "tolerance"} <= info.data.keys():
            return value  # their errors are reported instead
        tolerance, push = info.data["tolerance"], info.data["motion"].push
        x, y, z, Rz, Ry, Rx = value.nearest(np.zeros(POSE_SIZE), -1)
        nearest = np.array([x, y, max(z, min(z + push, 0.0)), Rx, Ry, Rz])  # the command may be below the seated plug
        if not tolerance.accepts(nearest) or max(abs(Ry), abs(Rx)) >= tolerance.turn * DEGREE:
            raise ValueError(
                "these bounds exclude the pose of the seated plug, which is 0 in all outputs: let them include 0 (for "
                "z, a value from -motion.push to 0) at the end of the motion"
            )
        return value

    @field_validator("sides", "rim_sides")
    @classmethod
    def _check_symmetries(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for name in value:
            if name not in SYMMETRIES:
                raise ValueError(f"there is no symmetry {name!r}: {did_you_mean(name, SYMMETRIES)}")
        return value

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the files in the task folder that `task.yaml` refers to."""
        models = (self.plug, self.socket)
        meshes = [*(model.visual for model in models), *(piece.file for model in models for piece in model.pieces)]
        convex = [file for model in models for file in model.convex if file not in meshes]
        maps = [self.search.contact_map] if self.search.contact_map is not None else []
        return (*meshes, *convex, self.demonstrations.file, *maps, *self.scenario)

    @property
    def is_convex(self) -> bool:
        """True if both parts have convex pieces, and `scenario` adds no other objects."""
        return bool(self.plug.convex and self.socket.convex) and not self.scenario

    @property
    def clearance(self) -> float:
        """Measured clearance between the parts [m]; 0 if it was not measured."""
        return MM * float(self.measured.get("clearance_mm") or 0.0)

    @property
    def turn(self) -> float:
        """Turn of the plug about z at the bottom [rad]."""
        return self.motion.turn * DEGREE


def is_plain_path(name: str) -> bool:
    """Return True if `name` is a path that a task file may use for a file in its folder."""
    return bool(_FILE_NAME.fullmatch(name)) and ".." not in name.split("/")


def read_task_file(folder: Path) -> PartTaskFile:
    """Read the task of a folder.

    Raises:
        InputError: If the folder is missing or not a task, a value is invalid, or a named file is missing or not in the
            folder.
    """
    path = folder / FILE_NAME
    if not folder.is_dir():
        raise InputError(f"there is no task folder {folder}: restore it, or create it with guiderail create-task")
    if not path.is_file():
        raise InputError(f"{folder} is no task: it has no {FILE_NAME}; guiderail create-task makes one")
    file = _parse(path, read_bytes(path, "task", MAX_SIZE))
    for name in file.files:
        if not is_plain_path(name):
            raise InputError(f"{path} names {brief(name)}, which is not a plain path inside {folder}: rename the file")
        if not (folder / name).is_file():
            raise InputError(f"{path} names {name}, which is not in {folder}: put it there, or create the task again")
    return file


@lru_cache(maxsize=256)  # a command reads each of its tasks several times, and 40 ms of a core parse one
def _parse(path: Path, content: bytes) -> PartTaskFile:
    data = parse_content(content, path, "task")
    if not isinstance(data, dict) or data.get("format") != FILE_FORMAT:
        raise InputError(f"{path} is no task: it must contain the line 'format: {FILE_FORMAT}'")
    try:
        return validate_options(PartTaskFile, data, "it")
    except InputError as error:
        raise InputError(f"{path} is invalid: {error}") from None


def task_folder_digest(folder: Path) -> str:
    """Return a digest of `task.yaml`, with the clearance as the only measurement, and of all files that it names.

    Raises:
        InputError: As `read_task_file`.
    """
    file = read_task_file(folder)
    content = hashlib.blake2b(file.model_dump_json(exclude={"measured"}).encode(), digest_size=16)
    content.update(repr(file.clearance).encode())  # it determines the hold tests
    for name in file.files:
        content.update(hashlib.blake2b((folder / name).read_bytes()).digest())
    return content.hexdigest()


def write_task_file(folder: Path, file: PartTaskFile) -> Path:
    """Write `task.yaml` with numbers of nine significant digits, and return its path.

    Raises:
        InputError: If the file cannot be written.
    """
    path = folder / FILE_NAME
    values = json.loads(json.dumps(file.model_dump()), parse_float=lambda digits: float(f"{float(digits):.9g}"))
    text = yaml.safe_dump(values, sort_keys=False, width=110, default_flow_style=None)
    write_atomically(path, text.encode())
    return path
