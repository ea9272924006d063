"""Package `peglab` of another lab, installed with its own task, guidance, kernel and learner."""

import json
import os
import shutil
import site
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest
from fork_server import Forks

PACKAGE = Path(__file__).parent / "peglab"
MAX_LINES = 180
PRELOADED = [
    *(f"guiderail.tools.{name}" for name in ("cli.commands", "learning.trainer", "evaluation.evaluate", "catalog")),
    *(
        f"guiderail.{name}"
        for name in ("diagrams.envs.make", "diagrams.guidance.primitive", "diagrams.tasks.narrow_passage")
    ),
]


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """Yield a function that runs an interpreter of a new virtual environment with the package and returns its output.

    The virtual environment imports guiderail and the libraries from the interpreter of this test.
    """
    folder = tmp_path_factory.mktemp("lab")
    environment = folder / "env"
    venv.create(environment, with_pip=False, symlinks=True)
    purelib = sysconfig.get_path("purelib", vars={"base": str(environment), "platbase": str(environment)})
    # The wheel is built and extracted as by pip, which takes seconds to start.
    source = shutil.copytree(PACKAGE, folder / "source", ignore=shutil.ignore_patterns("build", "*.egg-info"))
    build = f"from setuptools import build_meta; build_meta.build_wheel({str(folder)!r})"
    subprocess.run([sys.executable, "-c", build], cwd=source, check=True)
    (wheel,) = folder.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(purelib)
    # Folders of this interpreter with the libraries, and with guiderail and its entry points.
    shared = [sysconfig.get_path("purelib"), *site.getsitepackages(), *(p for p in sys.path if p.endswith("src"))]
    Path(purelib, "shared.pth").write_text("\n".join(dict.fromkeys(shared)) + "\n")

    variables = os.environ | {"OMP_NUM_THREADS": "1", "DRAKE_ALLOW_NETWORK": "meshcat:lcm"}
    variables.pop("PYTHONPATH", None)
    server = Forks(str(environment / "bin" / "python"), PRELOADED, env=variables)

    def run(*arguments, code=0):
        result = server.run(*arguments, folder=folder)
        assert result.returncode == code, result.stdout + result.stderr
        return result.stdout if code == 0 else result.stderr

    run.folder = folder
    yield run
    server.close()


def guiderail(lab, *arguments, code=0):
    """Run the command `guiderail` in the virtual environment; return its output, or its errors if `code` is not 0."""
    return lab("-c", "from guiderail.tools.cli.main import main; main()", *arguments, code=code)


@pytest.fixture(scope="module")
def run_folder(lab):
    """Return the folder of a run that is trained for three episodes."""
    guiderail(
        lab, "train", "peglab/Slot", "--guidance", "kgrl", "--algorithm", "peglab_hill_climbing", "--episodes", "3",
        "--env", "width=0.16", "--out", "run", "--no-pictures",
    )  # fmt: skip
    return lab.folder / "run"


def test_package_is_short():
    files = (PACKAGE / "peglab.py", PACKAGE / "pyproject.toml")
    assert sum(len(path.read_text().splitlines()) for path in files) <= MAX_LINES


def test_guiderail_does_not_name_the_package():
    root = Path(__file__).parents[2]
    for folder in ("models", "systems", "diagrams", "tools", "src"):
        assert not [path for path in (root / folder).rglob("*.py") if "peglab" in path.read_text()]


def test_list_has_task_guidance_and_learner(lab):
    catalog = json.loads(guiderail(lab, "list", "--json"))
    assert "peglab/Slot" in catalog["tasks"]
    assert "peglab_offset" in catalog["tasks"]["peglab/Slot"]["guidance"]
    assert "peglab_hill_climbing" in catalog["learners"]
    assert [option["name"] for option in catalog["tasks"]["peglab/Slot"]["options"]] == ["width"]


def test_gymnasium_makes_the_task(lab):
    code = (
        "import gymnasium; env = gymnasium.make('guiderail.diagrams:peglab/Slot-v0', guidance='peglab_offset', "
        "reach=0.02, width=0.2); env.reset(seed=0); print(env.step([1.0, 0.0])[4]['control_steps'])"
    )
    assert lab("-c", code).split() == ["5"]


def test_train_refuses_an_invalid_option_with_one_sentence(lab):
    message = guiderail(lab, "train", "peglab/Slot", "--env", "width=3", "--out", "wrong", code=2)
    assert "width must be at most 0.3" in message
    message = guiderail(lab, "train", "peglab/Slot", "--guidance", "sct", "--out", "wrong", code=2)
    assert "needs a shared control template, which peglab/Slot" in message


def test_run_is_resumed_and_evaluated(lab, run_folder):
    guiderail(lab, "train", "--resume", "--episodes", "4", "--out", "run", "--no-pictures")
    result = json.loads(guiderail(lab, "evaluate", "run", "--episodes", "2", "--baselines", "zero", "--json"))
    assert result["episodes"] == 2
    assert result["max_commanded_violation"] <= 1e-9


TRAIN = ("train", "peglab/Slot", "--guidance", "kgrl", "--algorithm", "peglab_hill_climbing", "--episodes", "1")


def test_settings_of_the_learner_are_validated(lab):
    guiderail(lab, *TRAIN, "--set", "deviation=0.1", "--out", "careful", "--no-pictures")
    assert "deviation: 0.1" in (lab.folder / "careful" / "config.yaml").read_text()
    for setting, sentence in (
        (
            "deviation=-1",
            "learner's deviation cannot be '-1' (input should be greater than 0): give a value such as 0.3",
        ),
        ("deviaton=1", "did you mean deviation?"),
        ("learning_rate=0.1", "peglab_hill_climbing has no setting 'learning_rate'"),
    ):
        assert sentence in guiderail(lab, *TRAIN, "--set", setting, "--out", "refused", code=2)
    message = guiderail(lab, *TRAIN, "--preset", "tqc_contact", "--out", "refused", code=2)
    assert "settings that peglab_hill_climbing does not have: leave --preset out" in message


def test_python_function_trains_the_task(lab):
    code = (
        "import guiderail\n"
        "settings = {'algorithm': 'peglab_hill_climbing', 'episodes': 2, 'width': 0.2, 'pictures': False}\n"
        "run = guiderail.train('peglab/Slot', 'kgrl', out='api', **settings)\n"
        "print(len(run.episodes), run.config.preset, run.config.environment['width'], run.policy.description['task'])"
    )
    assert lab("-c", code).split() == ["2", "None", "0.2", "peglab/Slot"]
    code = "import guiderail; print(guiderail.Policy.load('api').description['task'])"
    assert lab("-c", code).strip() == "peglab/Slot"


def test_training_uses_the_kernel_of_the_package(lab):
    kernel = ("--env", "kernel=peglab_rational_quadratic", "--env", "kernel.parameters={mixture: 2.0}")
    guiderail(lab, *TRAIN, *kernel, "--out", "kernel", "--no-pictures")
    assert "kernel: peglab_rational_quadratic" in (lab.folder / "kernel" / "config.yaml").read_text()


def test_evaluate_accepts_an_environment_without_guiderail(lab):
    code = (
        "import guiderail, peglab\n"
        "evaluation = guiderail.evaluate(lambda point: -3 * point, peglab.Reach(), 8)\n"
        "print(evaluation['success_rate'], evaluation.comparison.p < 0.05, *evaluation['baselines'])"
    )
    assert lab("-c", code).split() == ["1.0", "True", "zero", "uniform_random", "constant"]


def test_evaluate_accepts_a_function_in_a_file_as_policy(lab):
    (lab.folder / "lab_policies.py").write_text("import numpy as np\ndef ahead(observation):\n    return np.ones(2)\n")
    command = ("evaluate", "lab_policies.py:ahead", "--task", "peglab/Slot", "--episodes", "2", "--baselines", "none")
    assert json.loads(guiderail(lab, *command, "--json"))["episodes"] == 2


def test_visualize_writes_the_page_of_a_run(lab, run_folder):
    guiderail(lab, "visualize", "run", "--episodes", "1", "--html", "page.html")
    assert "peglab/Slot" in (lab.folder / "page.html").read_text()


def test_study_of_the_task_writes_its_results(lab):
    (lab.folder / "study.yaml").write_text(
        """
name: slot
task: peglab/Slot
learner: {algorithm: peglab_hill_climbing, episodes: 1}
methods:
  kgrl: {env: {guidance: kgrl}}
  zero: {env: {guidance: kgrl}, policy: zero}
seeds: [1]
eval_set:
  - {name: held_out, episodes: 1}
"""
    )
    guiderail(lab, "study", "study.yaml", "--processes", "1", "--out", "study", "--json")
    assert list((lab.folder / "study").glob("*.csv"))


def test_policy_of_a_run_is_simulated_in_a_diagram(lab, run_folder):
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
    (lab.folder / "local_task.py").write_text(
        "from guiderail import register_task\n"
        "from guiderail.diagrams.tasks.narrow_passage import NarrowPassage\n\n"
        "@register_task('local/Passage')\nclass LocalPassage(NarrowPassage):\n    duration = 0.8\n"
    )
    guiderail(
        lab, "train", "local/Passage", "--import", "local_task.py", "--episodes", "1", "--guidance", "kgrl",
        "--algorithm", "peglab_hill_climbing", "--out", "local", "--no-pictures",
    )  # fmt: skip
    # The run stores the name of the file, and `--trust-imports` permits its import.
    command = ("evaluate", "local", "--episodes", "1", "--trust-imports", "--baselines", "none", "--json")
    assert json.loads(guiderail(lab, *command))["episodes"] == 1
