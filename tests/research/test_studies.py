"""Every study file of research is valid."""

import pytest

from guiderail.tools.evaluation.metrics import statistics_of
from guiderail.tools.imports import import_modules
from guiderail_studies.declaration import load_study
from guiderail_studies.job import Job, check_job
from research.studies import study_names, study_path

pytestmark = pytest.mark.usefixtures("own_tasks")


@pytest.mark.parametrize("name", study_names())
def test_study_of_research_is_valid(name, tmp_path):
    study = load_study(study_path(name))
    assert study.name == name
    import_modules(study.imports)
    for method in study.methods:
        check_job(Job(study, method, study.seeds[0], tmp_path))
    for declared in study.ratios:
        assert declared.of.removeprefix("training_") in statistics_of(study.task)
        assert {declared.method, declared.against} <= study.methods.keys()
