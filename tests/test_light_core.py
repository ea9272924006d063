"""Core of the package: movement primitives, templates and constraints, which run without Drake and PyTorch."""

import subprocess
import sys
import textwrap
from pathlib import Path

from guiderail.models.common.errors import EXTRAS

BLOCK = f"""
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {sorted(EXTRAS)!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Blocked())
"""


def run_without_extras(code, *, exit_code=0):
    """Return the output of code in an interpreter that cannot import the modules of the extras."""
    program = BLOCK + textwrap.dedent(code)
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert result.returncode == exit_code, result.stderr
    return result.stdout + result.stderr


def test_core_runs_without_extras():
    """Primitive, template and `GuidedEnv` run in one process, because the import of the core takes a second."""
    output = run_without_extras(f"""
    import numpy as np
    from guiderail import Demonstrations, GuidedEnv, LcNsKmp, LinearConstraints, ReferenceTrajectory, load_template
    from guiderail.models.common.transforms import RigidTransform

    t = np.linspace(0.0, 1.0, 50)
    recorded = Demonstrations([t] * 3, [np.column_stack([np.sin(t), a * t]) for a in (0.9, 1.0, 1.1)])
    reference = ReferenceTrajectory.from_demonstrations(recorded, 4, floor=1e-3)
    constraints = LinearConstraints.box([-1.0, -1.0], [0.5, 2.0])
    primitive = LcNsKmp(reference, horizon=10, constraints=constraints)
    outputs = np.array([primitive.predict(step, np.array([50.0, 0.0])).output for step in range(50)])
    assert outputs[:, 0].max() <= 0.5 + 1e-9 and outputs[:, 0].max() > 0.499

    template = load_template("pouring")
    frames = {{"mug_tip": RigidTransform([0.6, 0.0, 0.3])}}
    X_WE = RigidTransform([0.6, -0.3, 0.45])
    state = template.state_at(X_WE, frames)
    for _ in range(50):
        request = template.displace(X_WE, template.map(state, np.array([0.0, 1.0, -1.0]), X_WE, frames, 0.02))
        X_WE = template.command(state, X_WE, request, frames, 0.02).X_WE
        assert template.violation(state, X_WE, frames) <= 1e-9
        state = template.next_state(state, X_WE, frames, 0.02)

    sys.path.insert(0, {str(Path(__file__).parent)!r})
    from guiderail.models.primitives import fit
    from point_env import PERIOD, PointEnv, demonstrations, pose, to_action

    fit._LENGTHS, fit._REGULARIZATIONS = (0.2,), (0.1,)  # each kernel of the selection takes time
    env = GuidedEnv(
        PointEnv(), demonstrations=demonstrations(), frame=lambda env, o: env.unwrapped.target, pose=pose,
        to_action=to_action, guidance="skgrl", period=PERIOD,
    )
    env.reset(seed=0)
    print(env.step(np.zeros(3))[4]["phase"], not {{"pydrake", "torch", "pandas"}} & set(sys.modules))
    """)
    assert output.strip() == "0.2 True"


def test_learners_import_neither_drake_nor_pandas():
    """The virtual environment with metaworld and robosuite (`make outside`) has neither package."""
    output = run_without_extras("""
    sys.meta_path.pop(0)  # the extras can be imported
    from guiderail.tools.learning import checkpoint, fast_sb3, networks
    print(not {"pydrake", "pandas"} & set(sys.modules))
    """)
    assert output.strip() == "True"


def test_missing_extra_is_named_with_its_install_command():
    output = run_without_extras("""
    import gymnasium, guiderail
    from guiderail.models.common.errors import require_extra

    for use in (
        lambda: guiderail.Robot,
        lambda: __import__("guiderail.systems"),
        lambda: gymnasium.make("guiderail/NarrowPassage-v0"),
        lambda: guiderail.train,
        lambda: require_extra("absent"),
    ):
        try:
            use()
        except Exception as error:
            print(type(error).__name__, error)
    """)
    message = 'this needs {}, which is not installed: pip install "guiderail[sim]"'
    *missing, absent = output.splitlines()
    for line, software in zip(missing, ("Drake", "Drake", "Drake", "pandas"), strict=True):
        assert line.endswith(message.format(software))
    assert absent == "ModuleNotFoundError No module named 'absent'"


def test_command_without_extras_exits_with_2_and_one_sentence():
    output = run_without_extras("from guiderail.__main__ import main; main()", exit_code=2)
    assert output == 'guiderail: this needs typer, which is not installed: pip install "guiderail[sim]"\n'


def test_train_without_torch_exits_with_2_and_names_the_extra(tmp_path):
    code = f"""
    class Torch(Blocked):
        def find_spec(self, name, path=None, target=None):
            if name.partition(".")[0] in ("torch", "stable_baselines3", "sb3_contrib"):
                raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
    sys.meta_path[0] = Torch()
    sys.argv = ["guiderail", "train", "NarrowPassage", "--episodes", "1", "--out", {str(tmp_path / "run")!r}]
    from guiderail.__main__ import main
    main()
    """
    output = run_without_extras(code, exit_code=2)
    assert 'which is not installed: pip install "guiderail[learn]"' in output
    assert len(output.splitlines()) == 1
    assert not (tmp_path / "run").exists()
