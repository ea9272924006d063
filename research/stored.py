"""Steps of a study whose results are stored as they are finished: training runs and evaluated episodes."""

import sys
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from guiderail.models.policy import Policy
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import make_baseline
from guiderail.tools.evaluation.evaluate import evaluate_policy
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.train import train
from guiderail.tools.tables import read_table, table_text


def report(text: str) -> None:
    """Print a line on the progress of the program."""
    print(text, file=sys.stderr, flush=True)


def continue_run(run: Path, episodes: int) -> bool:
    """Return True for a run that has its episodes, or was begun and is then continued; False if it has not begun."""
    if (run / "policy.safetensors").exists() and RunFolder(run).config().episodes >= episodes:
        return True
    report(f"training {run.name}")
    if not (run / "config.yaml").exists():
        return False
    train(out=run, episodes=episodes, resume=True, pictures=False)
    return True


def evaluate_stored(task: str, options: Mapping[str, Any], sources: Mapping[Path, Path | str], episodes: int) -> None:
    """Evaluate policies in the same held-out episodes of an environment; stored episodes are not simulated again.

    Args:
        task: Name of the task.
        options: Options of the environment.
        sources: Folder of a run, or name of a baseline policy, by the file (.csv) of its episodes.
        episodes: Number of held-out episodes of each policy.
    """
    missing = [file for file in sources if not file.exists() or len(read_table(file)) < episodes]
    if not missing:
        return
    with closing(make_environment(task, options)) as env:
        env.reset(seed=0)
        for file in missing:
            source = sources[file]
            act = Policy.load(source) if isinstance(source, Path) else make_baseline(task, source)(env)
            rows = evaluate_policy(env, act, episodes=episodes)
            file.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(file, table_text(rows).encode())
            report(f"{file.parent.name}, {file.stem}: {int(rows['success'].sum())} of {len(rows)}")
