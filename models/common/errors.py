"""Exceptions with messages for users, and errors of missing dependencies that name the extra to install."""

import reprlib
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any


class InputError(ValueError):
    """Error in user input: data, a file, an argument or a name.

    Its message is one sentence that names the problem and the remedy; the command prints it and exits with code 2. All
    errors in user input have this type, which distinguishes them from program errors.
    """


class RunsFailedError(RuntimeError):
    """Failure of some runs of a study after all others have finished.

    Attributes:
        sentences: One sentence for each failed run; the command prints them and exits with code 1.
        rows: Results of the other runs as a data frame, or None.
    """

    def __init__(self, sentences: list[str], rows: Any):
        super().__init__("; ".join(sentences))
        self.sentences, self.rows = sentences, rows


_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 60
_SHORT.maxlevel = 3


def brief(value: Any) -> str:
    """Return the repr of a value on one line, shortened for a message."""
    return " ".join(_SHORT.repr(value).split())


@contextmanager
def naming_failures(action: str, *unchanged: type[BaseException]) -> Iterator[None]:
    """Convert an error in a user's code to an `InputError` that names the action, the file, the line and the error.

    An `InputError` and errors of the types `unchanged` are raised unchanged.
    """
    reraised: tuple[type[BaseException], ...] = (InputError, *unchanged)
    try:
        yield
    except reraised:
        raise
    except (Exception, SystemExit) as error:
        frame = traceback.extract_tb(error.__traceback__)[-1]
        location = f"{Path(frame.filename).name}, line {frame.lineno}: " if frame.filename.endswith(".py") else ""
        message = " ".join(str(error).split())
        raise InputError(f"{action} failed: {location}{type(error).__name__}: {message}") from error


_SOFTWARE: dict[str, dict[str, str]] = {
    "sim": {
        "pydrake": "Drake",
        "typer": "typer",
        "click": "typer",
        "rich": "rich",
        "pandas": "pandas",
        "pyarrow": "pyarrow",
        "filelock": "filelock",
        "jinja2": "jinja2",
        "yaml": "PyYAML",
        "matplotlib": "matplotlib",
    },
    "learn": {"torch": "PyTorch", "stable_baselines3": "Stable-Baselines3", "sb3_contrib": "sb3-contrib"},
    "mujoco": {"mujoco": "MuJoCo"},
    "pybullet": {"pybullet": "PyBullet"},
    "sapien": {"sapien": "SAPIEN"},
    "parts": {"trimesh": "trimesh", "manifold3d": "manifold3d", "igl": "libigl", "cascadio": "cascadio"},
    "repair": {"pytetwild": "pytetwild", "pyvista": "PyVista"},
    "bags": {"rosbags": "rosbags"},
    "minari": {"minari": "Minari"},
    "fci": {"franky": "franky"},
    "rtde": {"rtde_control": "ur-rtde", "rtde_receive": "ur-rtde", "dashboard_client": "ur-rtde"},
    "ros2": {"cyclonedds": "Cyclone DDS"},
    "tensorboard": {"tensorboard": "TensorBoard"},
    "ray": {"ray": "Ray"},
    "onnx": {"onnxruntime": "ONNX Runtime"},
    "wandb": {"wandb": "Weights & Biases"},
    "calibration": {"guiderail_calibration": "guiderail-calibration", "sbi": "sbi"},
    **{name: {f"guiderail_{name}": f"guiderail-{name}"} for name in ("hardware", "data", "studies", "lerobot", "cpp")},
}
_SOFTWARE["mujoco"]["guiderail_mujoco"] = "guiderail-mujoco"
_SOFTWARE["parts"]["guiderail_parts"] = "guiderail-parts"
EXTRAS = {module: (name, extra) for extra, modules in _SOFTWARE.items() for module, name in modules.items()}
"""Software and the name of the extra that installs it, by the name of a module."""


class MissingExtraError(InputError, ImportError):
    """Error for a missing dependency of an extra; the message names the command that installs it."""


LIBRARIES = {"libglib-2.0.so.0": "libglib2.0-0"}
"""Debian's package by the name of a library of the operating system that Drake needs."""


def explain_missing(error: ImportError) -> MissingExtraError | None:
    """Return an error that names what to install; None if that is unknown."""
    library = str(error).partition(":")[0]
    if library in LIBRARIES:
        return MissingExtraError(
            f"Drake needs {library}, which this machine lacks: install it (Debian, Ubuntu: apt install "
            f"{LIBRARIES[library]})"
        )
    module = (error.name or "").partition(".")[0]
    if not isinstance(error, ModuleNotFoundError) or module not in EXTRAS:
        return None
    software, extra = EXTRAS[module]
    return MissingExtraError(f'this needs {software}, which is not installed: pip install "guiderail[{extra}]"')


def import_extra(module: str) -> Any:
    """Import a module of an extra, and return it.

    Raises:
        MissingExtraError: If the module is missing and an extra installs it.
        ModuleNotFoundError: If the module is missing and no extra installs it.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise (explain_missing(error) or error) from None


def require_extra(module: str) -> None:
    """Check that a module of an extra is installed, without the time for an import.

    Raises:
        MissingExtraError: If the module is missing and an extra installs it.
        ModuleNotFoundError: If the module is missing and no extra installs it.
    """
    try:
        is_installed = find_spec(module) is not None
    except (ImportError, ValueError):
        is_installed = False
    if not is_installed:
        error = ModuleNotFoundError(f"No module named {module!r}", name=module)
        raise (explain_missing(error) or error)
