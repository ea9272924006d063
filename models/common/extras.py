"""Optional dependencies: which extra of this package installs a module that is missing."""

from importlib.util import find_spec

from guiderail.models.common.errors import InputError

EXTRAS = {
    "pydrake": ("Drake", "sim"),
    "typer": ("typer", "sim"),
    "click": ("typer", "sim"),
    "rich": ("rich", "sim"),
    "pandas": ("pandas", "sim"),
    "pyarrow": ("pyarrow", "sim"),
    "filelock": ("filelock", "sim"),
    "jinja2": ("jinja2", "sim"),
    "yaml": ("PyYAML", "sim"),
    "matplotlib": ("matplotlib", "sim"),
    "torch": ("PyTorch", "learn"),
    "stable_baselines3": ("Stable-Baselines3", "learn"),
    "sb3_contrib": ("sb3-contrib", "learn"),
    "mujoco": ("MuJoCo", "mujoco"),
    "ray": ("Ray", "ray"),
    "onnxruntime": ("ONNX Runtime", "onnx"),
    "wandb": ("Weights & Biases", "wandb"),
}
"""Name of the software and of the extra by the name of the module."""


class MissingExtraError(InputError, ImportError):
    """A dependency of an extra is not installed; the message names the command that installs it."""


def explain_missing(error: ImportError) -> MissingExtraError | None:
    """Return the error with the remedy for a module that an extra installs; None for another module."""
    extra = EXTRAS.get((error.name or "").partition(".")[0])
    if extra is None:
        return None
    software, name = extra
    return MissingExtraError(f'this needs {software}, which is not installed: pip install "guiderail[{name}]"')


def require_extra(module: str) -> None:
    """Refuse to go on without a module of an extra; it is not imported, because importing takes time.

    Raises:
        MissingExtraError: If it is not installed.
    """
    try:
        is_installed = find_spec(module) is not None
    except (ImportError, ValueError):
        is_installed = False
    if not is_installed:
        error = ModuleNotFoundError(f"No module named {module!r}", name=module)
        raise (explain_missing(error) or error)
