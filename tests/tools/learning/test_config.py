import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.learning.learner import LEARNERS
from guiderail.tools.learning.learner_config import resolve_preset
from guiderail.tools.learning.train import train


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("ent_coef", "_0.5"), ("ent_coef", "auto0.5"), ("ent_coef", "inf"), ("ent_coef", "auto_nan"),
        ("ent_coef", "-1"), ("ent_coef", "much"), ("net_arch", ""), ("net_arch", "1000000,1000000"),
        ("gamma", 1.5), ("exploration.constant_episodes", -1), ("exploration.greedy_episode_fraction", 1.5),
        ("exploration.ez_greedy", 1.5), ("exploration.ez_greedy_longest", 0), ("exploration.ez_greedy_until", -1),
        ("net_arch.dropout", 1.0), ("selection.window", -1), ("batch_size", 2.5),
        ("batch_size", "1e20"), ("batch_size", True), ("buffer_size", "9" * 5000), ("net_arch.layer_norm", "7"),
        ("learning_rate", "inf"), ("gamma", True), ("gradient_steps", 10**12), ("net_arch", ",".join(["8"] * 50)),
    ],
)  # fmt: skip
def test_config_refuses_values_out_of_range(setting, value):
    with pytest.raises(InputError, match=f"learner's {setting} cannot be") as error:
        resolve_preset("tqc_contact", "tqc", {setting: value})
    assert len(str(error.value)) < 300


def test_learners_are_listed_without_importing_their_modules():
    assert {*LEARNERS._packaged} == {"bc", "chunk", "crossq", "distillation", "ppo", "sac", "td3", "tqc"}


@pytest.mark.parametrize(("num_demonstrations", "is_warned"), [(0, False), (1, True), (99, True)])
def test_warning_appears_when_only_the_scripted_policy_acts(num_demonstrations, is_warned, tmp_path, caplog):
    settings = {"demonstration_episodes": num_demonstrations, "net_arch": (8,), "gradient_steps": 1}
    options = {"settings": settings, "pictures": False, "difficulty": "hard"}
    train("NarrowPassage", out=tmp_path / "run", episodes=1, **options)
    messages = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert any("in none, because demonstration_episodes is" in message for message in messages) is is_warned
