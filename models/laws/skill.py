"""Law of an exported skill."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_SIZE
from guiderail.models.laws.primitive import PrimitiveLaw
from guiderail.models.primitives import LcNsKmp, LinearConstraints, ReferenceTrajectory, make_kernel

SKILL_FILE, PRIMITIVE_FILE = "skill.json", "primitive.npz"


def load_law(folder: Path | str) -> PrimitiveLaw:
    """Return the law of the guidance in a folder that ``guiderail export`` has written.

    Raises:
        InputError: If the folder has no exported skill with a movement primitive.
    """
    folder = Path(folder)
    try:
        skill = json.loads((folder / SKILL_FILE).read_text(encoding="utf-8"))
        settings = skill["primitive"]
        with np.load(folder / PRIMITIVE_FILE) as data:
            arrays = {name: data[name] for name in ("times", "means", "covariances", "G", "c", "gains")}
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{folder} is no exported skill ({error}): write it with guiderail export") from error
    primitive = LcNsKmp(
        ReferenceTrajectory(arrays["times"], arrays["means"], arrays["covariances"]),
        kernel=make_kernel(settings["kernel"], settings["length_scale"]),
        constraints=LinearConstraints(arrays["G"], arrays["c"]),
        **{key: settings[key] for key in ("lambda_", "beta", "horizon", "history", "history_variance")},
    )
    return PrimitiveLaw(
        primitive,
        arrays["gains"],
        outputs=[entry["output"] for entry in skill["action"]],
        history_source=settings["history_source"],
        near=primitive.reference.means[0] if primitive.num_outputs == POSE_SIZE else None,
    )
