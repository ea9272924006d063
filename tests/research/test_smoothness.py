import pytest

from guiderail.models.common.errors import InputError
from research.smoothness import measure, methods, quiet_commands, smoothness


@pytest.mark.parametrize("wrong", [{"episodes": 0}, {"action_scale": 0.0}, {"outputs": "some"}])
def test_the_benchmark_of_smoothness_refuses_too(tmp_path, wrong):
    with pytest.raises(InputError):
        smoothness(tmp_path / "new", **wrong)
    assert not (tmp_path / "new").exists()


def test_every_way_to_explore_has_a_name_of_its_own():
    names = [method.name for method in methods()]
    assert len(set(names)) == len(names)
    for kind in ("KGRL", "adaptive", "white", "gSDE", "pink", "OU", "low-pass", "repeat"):
        assert any(kind in name for name in names), kind


@pytest.fixture(scope="module")
def quiet():
    return quiet_commands()


@pytest.mark.parametrize("name", ["KGRL", "residual white"])
def test_every_way_to_explore_has_the_same_rms(name, quiet):
    (method,) = [method for method in methods() if method.name == name]
    free, contact = measure(method, (0, 1, 2, 3, 4, 5), quiet, episodes=1, action_scale=0.5, seed=0)
    assert (free["place"], contact["place"]) == ("free", "connector")
    assert free["rms_in_deviations"] == pytest.approx(0.5, rel=0.05)
