"""Mutation testing of the safety code.

    python tests/harness/mutation/mutate.py                         # all mutants, hours
    python tests/harness/mutation/mutate.py --every 8               # an eighth of them, by hashes of the names
    python tests/harness/mutation/mutate.py qp window               # of these files
    python tests/harness/mutation/mutate.py --results mutants.json  # resumes an interrupted run

Every operator below is applied wherever it fits: comparisons, arithmetic, logic, numbers, branches, statements, calls
with a counterpart, slices, keyword arguments, limits and constants × 1.001 (`mutations.py`). A mutant is tried with the
tests that execute its line, fastest and most successful first, in a fork of a process that has collected them. A mutant
that passes them survives. `survivors.yaml` explains why a survivor makes no difference. A survivor without an
explanation is an error, and so is an explanation without a surviving mutant.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import resource
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from enum import Enum
from functools import cached_property
from inspect import unwrap
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
import pytest
import yaml

sys.path.insert(0, str(Path(__file__).parents[1]))
from mutation.mutations import ROOT, Mutant, mutants

CONSTANTS = (bool, int, float, str, tuple, list, frozenset, set, np.ndarray)
WRAPPERS = (property, classmethod, staticmethod, cached_property)
TEST_MODULES: set[str] = set()
PRIMITIVES = ["tests/models/primitives"]
TEMPLATES = ["tests/models/templates"]
TARGETS = {
    **{f"models/primitives/{name}.py": PRIMITIVES for name in ("qp", "window", "lc_ns_kmp", "constraints")},
    **{f"models/primitives/{name}.py": PRIMITIVES for name in ("gains", "features", "kernels", "kmp")},
    **{f"models/primitives/{name}.py": PRIMITIVES for name in ("poses", "reference", "mixture", "demonstrations")},
    "models/templates/constraints.py": TEMPLATES,
    "models/templates/template.py": TEMPLATES,
    "models/templates/geometry.py": TEMPLATES,
    "models/control/keep_out.py": ["tests/models/control/test_keep_out.py"],
    "models/control/cartesian_impedance.py": ["tests/models/control/test_cartesian_impedance.py"],
    "models/control/joint_status.py": ["tests/models/control/test_joint_status.py"],
    "models/control/message_sequence.py": ["tests/models/control/test_message_sequence.py"],
    "models/control/state_estimator.py": ["tests/models/control/test_state_estimator.py"],
    "diagrams/hardware/driver_guard.py": ["tests/diagrams/hardware/test_driver_guard.py"],
    "diagrams/hardware/monitor.py": ["tests/diagrams/hardware/test_monitor.py"],
    **{
        f"systems/{path.name}": [f"tests/systems/test_{path.name}"]
        for path in sorted((ROOT / "systems").glob("*.py"))
        if path.stem != "__init__"
    },
    "systems/support/last_valid_pose.py": [
        "tests/systems/test_command_watchdog.py",
        "tests/systems/test_torque_safety_limiter.py",
    ],
    "systems/support/last_valid_bound.py": [
        "tests/systems/test_energy_tank.py",
        "tests/systems/test_cartesian_impedance_controller.py",
    ],
}
SURVIVORS = ROOT / "tests" / "harness" / "mutation" / "survivors.yaml"
# Slow imports without mutants, imported before a process is forked for each mutant.
HEAVY = ("daqp", "hypothesis.extra.numpy", "mpmath", "numpy", "osqp", "piqp", "pydrake.math", "pytest")
HEAVY += ("scipy.optimize", "scipy.sparse", "scipy.spatial.transform", "sklearn.mixture", "yaml", "matplotlib.figure")
HEAVY += (
    "pydrake.multibody.plant",
    "pydrake.systems.analysis",
    "pydrake.systems.framework",
    "pydrake.systems.primitives",
)


# --- tests ---


def graft(mutant: Mutant) -> None:
    """Replace the code, defaults and constants that a mutant changes in the modules of this process.

    The module cannot be imported again, because the tests have already imported it and its names.
    """
    name = "guiderail." + mutant.file.removesuffix(".py").replace("/", ".")
    module, names = sys.modules[name], {"__name__": name, "__file__": str(ROOT / mutant.file)}
    exec(compile(mutant.tree(), names["__file__"], "exec"), names)
    _graft_all(vars(module), {key: value for key, value in names.items() if not key.startswith("__")}, name)


def _graft_all(old: Mapping[str, Any], new: Mapping[str, Any], module: str, owner: type | None = None) -> None:
    for key, value in new.items():
        before, value = (_function(each) for each in (old.get(key), value))
        if isinstance(value, FunctionType) and isinstance(before, FunctionType) and value.__module__ == module:
            before.__code__ = value.__code__
            before.__defaults__ = _grafted(before.__defaults__, value.__defaults__)
            kept, defaults = before.__kwdefaults__ or {}, value.__kwdefaults__ or {}
            before.__kwdefaults__ = {k: v if _is_numeric(v) else kept.get(k, v) for k, v in defaults.items()}
        elif isinstance(value, type) and isinstance(before, type) and value.__module__ == module:
            if not issubclass(value, Enum):
                _graft_all(vars(before), vars(value), module, before)
        elif owner is not None and isinstance(value, CONSTANTS):
            if not key.startswith("__") and not np.array_equal(value, before):
                setattr(owner, key, value)
        elif isinstance(value, CONSTANTS) and not np.array_equal(value, before):
            for other in list(sys.modules.values()):
                if vars(other).get(key) is before and other.__name__.split(".")[0] in ("guiderail", *TEST_MODULES):
                    setattr(other, key, value)


def _grafted(before: tuple | None, after: tuple | None) -> tuple | None:
    """Return the defaults of a function with their numbers replaced by those of a mutant."""
    if before is None or after is None or len(before) != len(after):
        return after
    return tuple(b if _is_numeric(b) else a for a, b in zip(before, after, strict=True))


def _is_numeric(value: Any) -> bool:
    """Return True for a number, or a tuple of numbers."""
    return all(map(_is_numeric, value)) if isinstance(value, tuple) else isinstance(value, int | float)


def _function(value: Any) -> Any:
    """Return the function in a property, class method, static method or decorated function."""
    for name in ("fget", "__func__", "func"):
        value = getattr(value, name) if isinstance(value, WRAPPERS) and hasattr(value, name) else value
    return unwrap(value) if isinstance(value, FunctionType) else value


class _Coverage:
    """Pytest plugin that records the executed lines of mutated files and the CPU time of each test."""

    def __init__(self):
        self.files = {str(ROOT / file): file for file in TARGETS}
        self.own: dict[object, str | None] = {}
        self.lines: dict[str, dict[str, set[int]]] = defaultdict(lambda: defaultdict(set))
        self.seconds: dict[str, float] = defaultdict(float)
        self.test = ""

    def trace(self, frame, event, argument):
        code = frame.f_code
        if code not in self.own:
            self.own[code] = self.files.get(os.path.realpath(code.co_filename))
        return self._line if self.own[code] else None

    def _line(self, frame, event, argument):
        self.lines[self.own[frame.f_code]][self.test].add(frame.f_lineno)
        return self._line

    def pytest_runtest_logstart(self, nodeid):
        self.test, self.started = nodeid, time.process_time()
        sys.settrace(self.trace)

    def pytest_runtest_logfinish(self, nodeid):
        sys.settrace(None)
        self.seconds[nodeid] += time.process_time() - self.started
        self.test = ""


class _Session:
    """Pytest plugin that passes the collected tests to a function and does not run them."""

    def __init__(self, work: Callable[[dict[str, Any]], None]):
        self.work = work

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session):
        TEST_MODULES.update(item.module.__name__.split(".")[0] for item in session.items)
        self.work({item.nodeid: item for item in session.items})
        return True


def with_tests(tests: list[str], work: Callable[[dict[str, Any]], None], plugins: list[Any]) -> None:
    """Collect tests and call `work` with them, by name."""
    quiet = ["-q", "--no-header", "--no-summary", "-p", "no:cacheprovider", "-p", "no:xdist", "-W", "ignore"]
    if pytest.main([*quiet, *tests], plugins=[_Session(work), *plugins]) != 0:
        raise SystemExit(f"{' '.join(tests)} cannot be collected")


def run(items: list[Any]) -> int:
    """Run tests until one fails; return its index, -1 if all pass."""
    for index, item in enumerate(items):
        following = items[index + 1] if index + 1 < len(items) else None
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        if item.session.testsfailed:
            return index
    return -1


def _forked(work: Callable[[], Any], cpu_seconds: float, default: Any) -> Any:
    """Run `work` in a silent child process with limits; return its result, or the default if the process is killed."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        silent = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silent, 1)
        os.dup2(silent, 2)
        resource.setrlimit(resource.RLIMIT_CPU, (int(cpu_seconds), int(cpu_seconds) + 5))
        resource.setrlimit(resource.RLIMIT_AS, (8 * 2**30, 8 * 2**30))
        try:
            with open(writing, "w") as file:
                json.dump(work(), file)
        finally:
            os._exit(0)
    os.close(writing)
    with open(reading) as file:
        text = file.read()
    os.waitpid(child, 0)
    return json.loads(text) if text else default


def coverage(tests: list[str], items: dict[str, Any], watcher: _Coverage, store: Path) -> dict:
    """Return the lines of each file that each test executes and the CPU time of each test, without mutations.

    Args:
        tests: Test files or folders.
        items: Tests by name.
        watcher: Plugin of the session.
        store: JSON file in which results are stored, because measuring takes longer than many mutants.
    """
    key = f"{' '.join(tests)} {_newest(tests)}"
    kept = json.loads(store.read_text()) if store.exists() else {}
    if key not in kept:

        def work():
            failed = run(list(items.values()))
            lines = {file: {test: sorted(n) for test, n in of.items()} for file, of in watcher.lines.items()}
            return {"lines": lines, "seconds": watcher.seconds, "failed": failed}

        kept[key] = _forked(work, 3600, {"failed": 0})
        if kept[key].pop("failed") >= 0:
            raise SystemExit(f"{' '.join(tests)} fails without a mutation: fix it first")
        store.write_text(json.dumps(kept))
    return kept[key]


def _newest(tests: list[str]) -> float:
    """Return the time of the last change of the tests or of mutated files."""
    places = [ROOT / test for test in tests] + [ROOT / file for file in TARGETS]
    files = [file for place in places for file in (place.rglob("*.py") if place.is_dir() else [place])]
    return max(file.stat().st_mtime for file in files)


def killer(mutant: Mutant, items: dict[str, Any], covered: dict, kills: Counter[str]) -> str:
    """Return the test that fails with a mutant, of those that execute its line; an empty text if all pass."""
    here, seconds = range(mutant.line, mutant.last_line + 1), covered["seconds"]
    lines = covered["lines"].get(mutant.file, {})
    chosen = {test for test in seconds if any(line in here for line in lines.get(test, ()))}
    # Only the first test executes a shared fixture, and none executes constants and defaults: add the file's own tests.
    chosen |= {test for test in seconds if Path(test.split("::")[0]).stem == f"test_{Path(mutant.file).stem}"}
    chosen = sorted(chosen or seconds, key=lambda test: (seconds[test] + 1e-3) / (1.0 + kills[test]))
    limit = 10 + 5 * sum(seconds[test] for test in chosen)

    def work():
        graft(mutant)
        return run([items[test] for test in chosen])

    failed = _forked(work, limit, 0)
    return chosen[failed] if failed >= 0 else ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("files", nargs="*", help="names of files without .py (default: all)")
    parser.add_argument("--every", type=int, default=1, help="try one mutant of this many")
    parser.add_argument("--results", type=Path, help="JSON file of results, for resuming")
    parser.add_argument("--again", action="store_true", help="try survivors again")
    arguments = parser.parse_args()
    if unknown := {*arguments.files} - {Path(file).stem for file in TARGETS}:
        parser.error(f"there is no file of the safety code called {min(unknown)}")
    os.chdir(ROOT)
    for name in HEAVY:
        importlib.import_module(name)
    with tempfile.TemporaryDirectory() as folder:
        results = arguments.results.absolute() if arguments.results else Path(folder) / "mutants.json"
        files = [file for file in TARGETS if not arguments.files or Path(file).stem in arguments.files]
        wrong, total, killed = np.sum([try_file(file, arguments.every, results, arguments.again) for file in files], 0)
    print(f"total: {killed} of {total} killed ({killed / max(total, 1):.1%}); {wrong} to be explained or fixed")
    return min(int(wrong), 1)


def try_mutants(file: str, found: list[Mutant], kept: Path, again: bool) -> None:
    """Try the mutants of a file that have no result yet, in a process that has collected its tests."""
    tried = json.loads(kept.read_text()) if kept.exists() else {}
    results, reasons = tried.setdefault(file, {}), _reasons(file)
    watcher, kills = _Coverage(), Counter[str]()

    def work(items):
        covered = coverage(TARGETS[file], items, watcher, kept.with_suffix(".coverage"))
        for mutant in found:
            if mutant.name in results and not (again and results[mutant.name] == "survived"):
                continue
            test = killer(mutant, items, covered, kills)
            kills[test] += 1
            results[mutant.name] = f"killed by {test}" if test else "survived"
            if not test and mutant.name not in reasons:
                print(f"{file}:{mutant.line}: survives: {mutant.name}", file=sys.__stderr__, flush=True)
            kept.write_text(json.dumps(tried, indent=1, ensure_ascii=False))

    with_tests(TARGETS[file], work, [watcher])


def _reasons(file: str) -> dict[str, str]:
    return yaml.safe_load(SURVIVORS.read_text()).get(file, {})


def try_file(file: str, every: int, kept: Path, again: bool) -> tuple[int, int, int]:
    """Return the numbers of unexplained survivors and stale explanations, of mutants, and of killed mutants."""
    everything, reasons = mutants(file), _reasons(file)
    result = [mutant for mutant in everything if mutant.is_in_sample(every)]
    child = os.fork()
    if child == 0:
        status = 1
        try:
            try_mutants(file, result, kept, again)
            status = 0
        finally:
            os._exit(status)
    if os.waitpid(child, 0)[1]:
        raise SystemExit(f"{file}: the mutants could not be tried")
    results = json.loads(kept.read_text())[file] if kept.exists() else {}
    survivors = {mutant.name for mutant in result if results[mutant.name] == "survived"}
    killed = {mutant.name for mutant in result} - survivors
    stale = (set(reasons) - {mutant.name for mutant in everything}) | (killed & set(reasons))
    for name in sorted(stale):
        print(f"{file}: explained, but not a survivor: {name}", flush=True)
    known = len(survivors & set(reasons))
    print(f"{file}: {len(killed)} of {len(result)} killed, {known} explained, {len(survivors) - known} not", flush=True)
    return len(survivors) - known + len(stale), len(result), len(killed)


if __name__ == "__main__":
    sys.exit(main())
