"""Checkpoint files, which contain no code and resume a run bit for bit; selection of the exported actor."""

import json
import random
from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from guiderail.models.common.errors import InputError
from guiderail.models.common.files import digest
from guiderail.tools.files import write_atomically
from guiderail.tools.pretrained import find_run

Actor = dict[str, torch.Tensor]
Entry = TypeVar("Entry")


@dataclass
class Candidate:
    """Actor of a greedy episode, with the numbers of consecutive greedy successes before the episode and from it on."""

    actor: Actor  # parameters by name
    before: int  # number of successes before the episode
    since: int = 0  # number of successes from the episode on

    def score(self) -> int:
        """Return the smaller of both numbers: an actor that succeeds by luck has few successes before or after it."""
        return min(self.before, self.since)


class CheckpointSelection:
    """Selection of the latest actor in the middle of the longest streak of successful greedy episodes.

    Learning at the edge of contact oscillates: a policy that succeeds for twenty episodes can fail for two and recover,
    so the last actor of a run is a poor choice. Held-out conditions must not influence the choice. The successes after
    an actor's own episode are those of later actors, so its score also counts the successes before the episode.
    """

    def __init__(self, window: int):
        """Construct the selection; more than `window` successes before or after an actor count as `window`."""
        self.window = window
        self._selected: Candidate | None = None
        self._open: list[Candidate] = []  # candidates of the current streak

    def begin(self, actor: torch.nn.Module, before: int) -> None:
        """Start a greedy episode of `actor` after `before` consecutive greedy successes."""
        copy = {key: value.detach().clone() for key, value in actor.state_dict().items()}
        self._open.append(Candidate(copy, min(before, self.window)))

    def finish(self, success: bool) -> None:
        """End the greedy episode."""
        if not success:
            self._selected, self._open = self._best(), []
            return
        for candidate in self._open:
            candidate.since += 1
        while self._open and self._open[0].since >= self.window:
            self._selected = self._better(self._selected, self._open.pop(0))

    def exclude(self) -> None:
        """End the greedy episode without counting it."""
        self._open.pop()

    def result(self) -> Actor | None:
        """Return the parameters of the best actor so far; None if no actor has a score of at least 1."""
        best = self._best()
        return None if best is None else best.actor

    def _best(self) -> Candidate | None:
        return reduce(self._better, self._open, self._selected)

    @staticmethod
    def _better(best: Candidate | None, candidate: Candidate) -> Candidate | None:
        required = 1 if best is None else best.score()
        return candidate if candidate.score() >= required else best

    def state(self) -> tuple[Actor, dict[str, Any]]:
        """Return the state between episodes: tensors by name, and JSON-serializable values."""
        candidates = {str(index): candidate for index, candidate in enumerate(self._open)}
        if self._selected is not None:
            candidates["selected"] = self._selected
        tensors = {f"{name}/{key}": tensor for name, each in candidates.items() for key, tensor in each.actor.items()}
        return tensors, {"rows": {name: [each.before, each.since] for name, each in candidates.items()}}

    def restore(self, tensors: Mapping[str, torch.Tensor], values: Mapping[str, Any]) -> None:
        """Restore a result of `state`."""
        candidates = {name: Candidate(entries_of(tensors, name), *rows) for name, rows in values["rows"].items()}
        self._selected = candidates.pop("selected", None)
        self._open = [candidates[name] for name in sorted(candidates, key=int)]


def entries_of(entries: Mapping[str, Entry], part: str) -> dict[str, Entry]:
    """Return the entries whose names begin with `part`/, without this prefix."""
    return {name.removeprefix(f"{part}/"): entry for name, entry in entries.items() if name.startswith(f"{part}/")}


def save_checkpoint(path: Path, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
    """Write arrays and JSON values with a digest; if killed while writing, the previous checkpoint stays."""
    arrays = {key: np.ascontiguousarray(value) for key, value in arrays.items()}
    text = json.dumps(values)
    write_atomically(path, save(arrays, {"values": text, "digest": digest(arrays, text)}))


def load_checkpoint(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read the arrays and values that `save_checkpoint` wrote."""
    if not path.is_file():
        raise InputError(f"there is no checkpoint {path}: train again in another folder")
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata()
            arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (`file` is no dictionary)
        text = metadata["values"]
        if metadata["digest"] != digest(arrays, text):
            raise ValueError("the digest differs")
        return arrays, json.loads(text)
    except (SafetensorError, ValueError, KeyError, TypeError, OSError, RecursionError) as error:
        raise InputError(
            f"the checkpoint {path} is damaged: restore a copy, or train again in another folder"
        ) from error


def load_off_policy(run: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the state of a run's off-policy learner; without the last episode if it was trained on a robot."""
    from guiderail.tools.learning.run_folder import RunFolder  # imports pandas, which the learners do not need

    file = RunFolder(find_run(run)).checkpoint
    if not file.is_file():
        raise InputError(
            f"init_from names {run}, which has no checkpoint: name the folder of a trained run, or let its policy "
            "demonstrate with --set demonstrator=..."
        )
    arrays, stored = load_checkpoint(file)
    arrays, values = {k: v for k, v in arrays.items() if not k.startswith("episodes/")}, stored["learner"]
    if "acting" in values:  # trained on a robot, where only the acting process counts the episodes
        arrays, values = entries_of(arrays, "learning"), values["learning"] | {"episodes": values["acting"]["episodes"]}
    if "exploration" not in values:
        raise InputError(f"init_from names {run}, whose learner is not off-policy: name a run of the same algorithm")
    return arrays, values


def module_arrays(
    modules: Mapping[str, torch.nn.Module], optimizers: Mapping[str, torch.optim.Optimizer]
) -> dict[str, np.ndarray]:
    """Return the parameters and buffers of modules and the moments of optimizers as arrays by name."""
    arrays: dict[str, np.ndarray] = {}
    for name, module in modules.items():
        arrays |= {f"{name}/{key}": value.cpu().numpy() for key, value in module.state_dict().items()}
    for name, optimizer in optimizers.items():
        for index, moments in optimizer.state_dict()["state"].items():
            arrays |= {f"optimizer/{name}/{index}/{key}": value.cpu().numpy() for key, value in moments.items()}
    return arrays


def restore_modules(
    arrays: Mapping[str, Any],
    modules: Mapping[str, torch.nn.Module],
    optimizers: Mapping[str, torch.optim.Optimizer],
) -> None:
    """Restore modules and optimizers from a result of `module_arrays`; the moments of optimizers must be tensors."""
    for name, module in modules.items():
        load_module(module, entries_of(arrays, name))
    for name, optimizer in optimizers.items():
        moments: dict[int, dict[str, torch.Tensor]] = {}
        for key, value in entries_of(arrays, f"optimizer/{name}").items():
            index, moment = key.split("/")
            moments.setdefault(int(index), {})[moment] = value
        optimizer.load_state_dict({"state": moments, "param_groups": optimizer.state_dict()["param_groups"]})


def load_module(module: torch.nn.Module, arrays: Mapping[str, Any]) -> None:
    """Set the parameters and buffers of a module from arrays or tensors by name.

    Each array is reshaped to the module's shape, because safetensors stores 0-d arrays, such as step counters, as 1-d.
    """
    shapes = {name: value.shape for name, value in module.state_dict().items()}
    tensors = {name: torch.as_tensor(value) for name, value in arrays.items()}
    module.load_state_dict({name: value.reshape(shapes.get(name, value.shape)) for name, value in tensors.items()})


def random_state() -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the states of the global random generators, which Stable-Baselines3 samples from.

    Returns:
        Arrays by name, and JSON-serializable values.
    """
    kind, keys, *rest = np.random.get_state(legacy=True)  # noqa: NPY002 (Stable-Baselines3 samples from it)
    arrays = {"random/torch": torch.get_rng_state().numpy(), "random/numpy": np.asarray(keys)}
    if torch.cuda.is_initialized():  # so that a resumed run samples the same numbers
        arrays["random/cuda"] = torch.cuda.get_rng_state().numpy()
    version, state, gauss = random.getstate()
    return arrays, {"numpy": [kind, *rest], "python": [version, list(state), gauss]}


def restore_random(arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
    """Set the global random generators to the states that `random_state` returned."""
    torch.set_rng_state(torch.from_numpy(np.array(arrays["random/torch"])))
    if "random/cuda" in arrays:
        torch.cuda.set_rng_state(torch.from_numpy(np.array(arrays["random/cuda"])))
    kind, *rest = values["numpy"]
    np.random.set_state((kind, arrays["random/numpy"], *rest))  # noqa: NPY002
    version, state, gauss = values["python"]
    random.setstate((version, tuple(state), gauss))
