"""MuJoCo, where it is installed."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from guiderail.models.errors import InputError


def mujoco_engine() -> ModuleType:
    """The module `mujoco`.

    Raises:
        InputError: if it isn't installed.
    """
    try:
        return import_module("mujoco")
    except ModuleNotFoundError:
        raise InputError(
            "station='mujoco' needs the package mujoco, which is not installed: pip install 'guiderail[mujoco]'"
        ) from None
