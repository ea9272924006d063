"""All that a run needs to go on as if it had never stopped, in one file that holds no code."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from guiderail.models.digest import digest
from guiderail.models.errors import InputError
from guiderail.tools.files import write_atomically


def save_checkpoint(path: Path, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
    """Writes arrays and JSON values with a digest of both; a run killed while writing keeps its last checkpoint."""
    arrays = {key: np.ascontiguousarray(value) for key, value in arrays.items()}
    text = json.dumps(values)
    write_atomically(path, save(arrays, {"values": text, "digest": digest(arrays, text)}))


def load_checkpoint(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """What `save_checkpoint` wrote.

    Raises:
        InputError: if the file is missing, truncated or changed.
    """
    if not path.is_file():
        raise InputError(f"there is no checkpoint {path}: start the run anew in another folder")
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata()
            arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (it is no dictionary)
        text = metadata["values"]
        if metadata["digest"] != digest(arrays, text):
            raise ValueError("the digest differs")
        return arrays, json.loads(text)
    except (SafetensorError, ValueError, KeyError, TypeError, OSError, RecursionError) as error:
        raise InputError(
            f"the checkpoint {path} is damaged: restore a copy, or start anew in another folder"
        ) from error
