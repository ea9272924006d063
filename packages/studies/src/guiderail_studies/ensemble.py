"""Ensemble of the policies of several runs."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from guiderail.models.common.errors import InputError
from guiderail.models.policy import Ensemble, Policy
from guiderail.tools.evaluation.subject import refuse_guidance_change
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.pretrained import find_run


def write_ensemble(runs: Sequence[str | Path], out: Path, search: Mapping[str, Any] | None = None) -> Ensemble:
    """Write the mean of several runs' policies as a run folder with the configuration of the first run.

    The folder has no table of episodes and no checkpoint. Commands evaluate it like a run. `search` has the arguments
    of a `RimSearch`; None for none.
    """
    if len(runs) < 2:
        raise InputError("an ensemble has the policies of several runs: name at least two")
    folders = [RunFolder(find_run(run)) for run in runs]
    configs = [folder.config() for folder in folders]
    for config in configs[1:]:
        refuse_guidance_change(configs[0].environment, config.environment)
    try:
        members = [Policy.load(folder.path) for folder in folders]
        ensemble = Ensemble(members, None if search is None else {**members[0].description, "search": dict(search)})
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{error}: give runs of the same task and options") from error
    folder = RunFolder(out)
    with folder.locked():
        folder.create(configs[0])
        ensemble.save(out, write=write_atomically)
    return ensemble
