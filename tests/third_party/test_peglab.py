"""A package with a task, guidance and a learner of its own, as a lab would install it."""

import json
import os
import site
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent / "peglab"
LINES = 180


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A fresh environment with the package installed; what is heavy is borrowed from the one that runs this test."""
    folder = tmp_path_factory.mktemp("lab")
    environment = folder / "env"
    venv.create(environment, with_pip=False, symlinks=True)
    purelib = sysconfig.get_path("purelib", vars={"base": str(environment), "platbase": str(environment)})
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--target", purelib]
    subprocess.run([*pip, str(PACKAGE)], check=True)
    # The libraries, and guiderail with its entry points, as this interpreter has them.
    borrowed = [sysconfig.get_path("purelib"), *site.getsitepackages(), *(p for p in sys.path if p.endswith("src"))]
    Path(purelib, "borrowed.pth").write_text("\n".join(dict.fromkeys(borrowed)) + "\n")

    variables = os.environ | {"OMP_NUM_THREADS": "1", "DRAKE_ALLOW_NETWORK": "meshcat:lcm"}
    variables.pop("PYTHONPATH", None)
    served = subprocess.Popen(
        [str(environment / "bin" / "python"), str(Path(__file__).parents[1] / "served.py")],
        cwd=folder, env=variables, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert served.stdout.readline() == "ready\n"

    def run(*arguments, code=0):
        served.stdin.write(json.dumps({"arguments": arguments, "folder": str(folder), "environment": {}}) + "\n")
        served.stdin.flush()
        result = json.loads(served.stdout.readline())
        assert result["returncode"] == code, result["stdout"] + result["stderr"]
        return result["stdout"] if code == 0 else result["stderr"]

    run.folder = folder
    yield run
    served.stdin.close()
    served.wait()


def guiderail(lab, *arguments, code=0):
    """The command, as it is installed."""
    return lab("-c", "from guiderail.tools.cli.main import main; main()", *arguments, code=code)


@pytest.fixture(scope="module")
def trained(lab):
    guiderail(
        lab, "train", "peglab/Slot", "--guidance", "kgrl", "--algorithm", "peglab_hill_climbing", "--episodes", "3",
        "--env", "width=0.16", "--out", "run",
    )  # fmt: skip
    return lab.folder / "run"


def test_it_is_small_enough_to_be_worth_it():
    files = (PACKAGE / "peglab.py", PACKAGE / "pyproject.toml")
    assert sum(len(path.read_text().splitlines()) for path in files) <= LINES


def test_no_file_of_guiderail_names_it():
    root = Path(__file__).parents[2]
    for folder in ("models", "systems", "diagrams", "tools", "src"):
        assert not [path for path in (root / folder).rglob("*.py") if "peglab" in path.read_text()]


def test_it_is_listed(lab):
    there = json.loads(guiderail(lab, "list", "--json"))
    assert "peglab/Slot" in there["tasks"]
    assert "peglab_offset" in there["tasks"]["peglab/Slot"]["guidance"]
    assert "peglab_hill_climbing" in there["learners"]
    assert [option["name"] for option in there["tasks"]["peglab/Slot"]["options"]] == ["width"]


def test_gymnasium_makes_it(lab):
    code = (
        "import gymnasium; env = gymnasium.make('guiderail.diagrams:peglab/Slot-v0', guidance='peglab_offset', "
        "reach=0.02, width=0.2); env.reset(seed=0); print(env.step([1.0, 0.0])[4]['control_steps'])"
    )
    assert lab("-c", code).split() == ["5"]


def test_a_wrong_option_gets_a_sentence(lab):
    said = guiderail(lab, "train", "peglab/Slot", "--env", "width=3", "--out", "wrong", code=2)
    assert "width must be at most 0.3" in said
    said = guiderail(lab, "train", "peglab/Slot", "--guidance", "sct", "--out", "wrong", code=2)
    assert "needs a shared control template, which peglab/Slot" in said


def test_it_is_trained_resumed_and_evaluated(lab, trained):
    guiderail(lab, "train", "--resume", "--episodes", "4", "--out", "run", "--no-pictures")
    result = json.loads(guiderail(lab, "evaluate", "run", "--episodes", "2", "--json"))
    assert result["episodes"] == 2
    assert result["max_commanded_violation"] <= 1e-9


def test_a_setting_of_its_learner_is_validated(lab):
    words = ("train", "peglab/Slot", "--guidance", "kgrl", "--algorithm", "peglab_hill_climbing", "--episodes", "1")
    guiderail(lab, *words, "--set", "deviation=0.1", "--out", "careful", "--no-pictures")
    assert "deviation: 0.1" in (lab.folder / "careful" / "config.yaml").read_text()
    for setting, sentence in (
        (
            "deviation=-1",
            "learner's deviation cannot be '-1' (input should be greater than 0): give a value such as 0.3",
        ),
        ("deviaton=1", "did you mean deviation?"),
        ("learning_rate=0.1", "peglab_hill_climbing has no setting 'learning_rate'"),
    ):
        assert sentence in guiderail(lab, *words, "--set", setting, "--out", "refused", code=2)
    said = guiderail(lab, *words, "--preset", "tqc_contact", "--out", "refused", code=2)
    assert "settings that peglab_hill_climbing does not have: leave --preset out" in said


def test_the_python_api_trains_it(lab):
    code = (
        "import guiderail\n"
        "settings = {'algorithm': 'peglab_hill_climbing', 'episodes': 2, 'width': 0.2, 'pictures': False}\n"
        "run = guiderail.train('peglab/Slot', 'kgrl', out='api', **settings)\n"
        "print(len(run.episodes), run.config.preset, run.config.environment['width'], run.policy.description['task'])"
    )
    assert lab("-c", code).split() == ["2", "None", "0.2", "peglab/Slot"]
    code = "import guiderail; print(guiderail.Policy.load('api').description['task'])"
    assert lab("-c", code).strip() == "peglab/Slot"


def test_its_kernel_is_a_choice(lab):
    words = ("train", "peglab/Slot", "--guidance", "kgrl", "--algorithm", "peglab_hill_climbing", "--episodes", "1")
    own = ("--env", "kernel=peglab_rational_quadratic", "--env", "kernel_parameters={mixture: 2.0}")
    guiderail(lab, *words, *own, "--out", "smoother", "--no-pictures")
    assert "kernel: peglab_rational_quadratic" in (lab.folder / "smoother" / "config.yaml").read_text()


def test_policies_are_judged_in_its_environment_of_other_origin(lab):
    code = (
        "import guiderail, peglab\n"
        "evaluation = guiderail.evaluate(lambda point: -3 * point, peglab.Reach(), 8)\n"
        "print(evaluation['success_rate'], evaluation.comparison.p < 0.05, *evaluation['baselines'])"
    )
    assert lab("-c", code).split() == ["1.0", "True", "zero", "uniform_random", "constant"]


def test_its_function_is_a_policy_of_the_command(lab):
    (lab.folder / "lab_policies.py").write_text("import numpy as np\ndef ahead(observation):\n    return np.ones(2)\n")
    words = ("evaluate", "lab_policies.py:ahead", "--task", "peglab/Slot", "--episodes", "2", "--baselines", "none")
    assert json.loads(guiderail(lab, *words, "--json"))["episodes"] == 2


def test_it_is_replayed(lab, trained):
    guiderail(lab, "visualize", "run", "--episodes", "1", "--html", "page.html")
    assert "peglab/Slot" in (lab.folder / "page.html").read_text()


def test_it_is_studied(lab, trained):
    (lab.folder / "study.yaml").write_text(
        """
name: slot
task: peglab/Slot
learner: {algorithm: peglab_hill_climbing, episodes: 3}
methods:
  kgrl: {env: {guidance: kgrl}}
  zero: {env: {guidance: kgrl}, policy: zero}
seeds: [1]
eval_set:
  - {name: held_out, episodes: 3}
"""
    )
    guiderail(lab, "study", "study.yaml", "--processes", "1", "--out", "study", "--json")
    assert list((lab.folder / "study").glob("*.csv"))


def test_learned_skill_is_a_plain_diagram(lab, trained):
    code = (
        "from pathlib import Path; import numpy as np; from pydrake.systems.analysis import Simulator\n"
        "from guiderail import make_skill; from guiderail.models.policy import Policy\n"
        "skill = make_skill('peglab/Slot', Policy.load(Path('run')), guidance='kgrl', width=0.16)\n"
        "simulator = Simulator(skill.diagram)\n"
        "skill.randomize(simulator.get_mutable_context(), np.random.default_rng(0), {})\n"
        "simulator.AdvanceTo(0.5); print(skill.diagram.GetOutputPort('pose').Eval(simulator.get_context())[1] > 0.2)"
    )
    assert lab("-c", code).split() == ["True"]


def test_task_in_a_file_works_without_installation(lab):
    (lab.folder / "mine.py").write_text(
        "from guiderail import register_task\n"
        "from guiderail.diagrams.tasks.narrow_passage.task import NarrowPassage\n\n"
        "@register_task('mine/Passage')\nclass Mine(NarrowPassage):\n    num_steps = 40\n"
    )
    guiderail(
        lab, "train", "mine/Passage", "--import", "mine.py", "--episodes", "2", "--guidance", "kgrl",
        "--algorithm", "peglab_hill_climbing", "--out", "mine", "--no-pictures",
    )  # fmt: skip
    # The run remembers what it needs, and imports it if that is trusted.
    words = ("evaluate", "mine", "--episodes", "2", "--trust-imports", "--baselines", "none", "--json")
    assert json.loads(guiderail(lab, *words))["episodes"] == 2
