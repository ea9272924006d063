import pandas as pd
import pytest

from guiderail.models.errors import InputError
from guiderail.tools.figures.thesis import THESIS
from guiderail.tools.studies.declaration import shipped_studies
from guiderail.tools.studies.results import FIGURES, write_results
from guiderail.tools.tables import write_table


@pytest.fixture
def finished(tmp_path):
    rows = [
        {
            "method": "skgrl", "mark": 40, "judged_on": "rails", "seed": seed, "success_rate": rate,
            "training_episodes": 40, "training_converged_after": after, "training_worst_violation": -1e-4,
            "training_collisions": 1, "training_wall_time": 1800.0,
        }
        for seed, rate, after in ((30, 1.0, 12), (31, 0.97, None))
    ]  # fmt: skip
    rows.append({"method": "nothing", "mark": 0, "judged_on": "rails", "seed": 0, "success_rate": 0.14})
    write_table(tmp_path / "study" / "connector", pd.DataFrame(rows))
    return tmp_path / "study"


def test_every_seed_stands_beside_the_thesis_with_what_differs(finished, tmp_path):
    page = write_results([finished], tmp_path / "results").read_text()
    assert "| skgrl | 40 | rails | 100%, 97% | 12, never | within | 2 | 1.00 |" in page
    assert "| nothing | – | rails | 14% | – | – | – | – |" in page
    assert THESIS["5.9"] in page
    assert "guiderail study connector --out studies" in page
    (differs,) = (line for line in page.splitlines() if line.startswith("Differs from the thesis in (skgrl)"))
    assert "reward shaped (thesis: sparse)" in differs


def test_the_page_is_written_anew_from_what_is_stored(finished, tmp_path):
    first = write_results([finished], tmp_path / "results").read_bytes()
    assert write_results([], tmp_path / "results").read_bytes() == first


def test_what_is_no_study_is_refused(tmp_path):
    with pytest.raises(InputError, match="holds no table of a study"):
        write_results([tmp_path], tmp_path / "results")
    with pytest.raises(InputError, match="name folders of studies"):
        write_results([], tmp_path / "results")


def test_figures_stand_beside_studies_that_there_are():
    assert set(FIGURES) <= set(shipped_studies())
    assert {number for numbers in FIGURES.values() for number in numbers} <= set(THESIS)
