"""Declared values of tasks, guidance and stations, compared with the registered entries."""

import subprocess
import sys

from guiderail.diagrams.envs.config import option_models, prior_of, stations_of
from guiderail.diagrams.envs.options import option_fields
from guiderail.diagrams.guidance.registry import possible_guidance
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.tools.environments import declared_models

TASKS_WITH_OPTIONS = [name for name in TASKS.names() if TASKS.is_packaged(name)]


def test_every_option_of_an_environment_is_declared():
    assert {"BncConnector", "GridClamp", "NarrowPassage"} <= {*TASKS_WITH_OPTIONS}
    for name in TASKS_WITH_OPTIONS:
        task, declared = TASKS.get(name), declared_models(name)
        for guidance in possible_guidance(prior_of(task).provides):
            for station in stations_of(task):
                known = {option for model in declared for option in option_fields(model)}
                used = {
                    option
                    for model in option_models(task, guidance, station).values()
                    for option in option_fields(model)
                }
                assert used <= known, (name, guidance, station)


def test_option_models_import_no_slow_package():
    code = """
import sys
from guiderail.tools.environments import declared_models
for name in ("BncConnector", "GridClamp", "NarrowPassage"):
    declared_models(name)
sys.exit(", ".join({"pydrake", "torch", "pandas"} & set(sys.modules)))
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert not result.stderr.strip(), result.stderr
