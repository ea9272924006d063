"""Mutation testing of the safety code.

    python tests/harness/mutation/mutate.py                         # all mutants, hours
    python tests/harness/mutation/mutate.py --every 8               # an eighth, chosen by hashes of their names
    python tests/harness/mutation/mutate.py qp window               # mutants of these files
    python tests/harness/mutation/mutate.py --results mutants.json  # resumes an interrupted run
    python tests/harness/mutation/mutate.py --only mutants.json     # the mutants in the results of another run

The operators in `mutations.py` change comparisons, arithmetic, logic, numbers, branches, statements, calls with a
counterpart, slices and keyword arguments, and multiply limits and constants by 1.001. A mutant is tested in a fork of a
process that has collected the tests. The tests that execute its line run until the first failure, fast tests and
tests that have killed many mutants first. A mutant that passes all of them survives. A mutant counts as killed only if
the same tests pass, in the same order and process, with the unchanged file in place of the mutant; otherwise the run
stops. `survivors.yaml` explains why a survivor makes no difference. A survivor without an explanation is an error, and
so is an explanation without a surviving mutant.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import os
import re
import resource
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from enum import Enum
from functools import cached_property, lru_cache
from inspect import unwrap
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
import pytest
import yaml

sys.path.insert(0, str(Path(__file__).parents[1]))
from mutation.mutations import ROOT, Mutant, mutants


def _systems(path: Path) -> list[str]:
    """Return the names of the systems of a file, in snake case, by which their test files are named."""
    names = re.findall(r"^class (\w+)\((?:LeafSystem|ConvertibleSystem)\)", path.read_text(), re.MULTILINE)
    return [re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower() for name in names]


CONSTANTS = (bool, int, float, str, tuple, list, frozenset, set, np.ndarray)
WRAPPERS = (property, classmethod, staticmethod, cached_property)
_CACHED = type(lru_cache(len))
TEST_MODULES: set[str] = set()
PRIMITIVES = ["tests/models/primitives"]
HARDWARE = "packages/hardware"
TEMPLATES = ["tests/models/templates"]
TARGETS = {
    **{f"models/primitives/{name}.py": PRIMITIVES for name in ("qp", "window", "lc_ns_kmp", "constraints")},
    **{f"models/primitives/{name}.py": PRIMITIVES for name in ("gains", "kernels", "kmp")},
    **{f"models/primitives/{name}.py": PRIMITIVES for name in ("poses", "reference", "mixture", "demonstrations")},
    "models/templates/active_constraints.py": TEMPLATES,
    "models/templates/template.py": TEMPLATES,
    "models/templates/parts.py": TEMPLATES,
    "models/control/command_filters.py": ["tests/models/control/test_keep_out.py"],
    "models/control/wrench.py": [
        "tests/models/control/test_wrench.py",
        "tests/models/control/test_cartesian_impedance.py",
        "tests/systems/test_reference_governor.py",
        "tests/systems/test_phase_wrench_limit.py",
        "tests/systems/test_energy_tank.py",
        "tests/systems/test_center_of_pressure.py",
        "tests/systems/test_mean_contact_point.py",
        "tests/systems/test_wrench_sensor.py",
        "tests/systems/test_wrong_arguments.py",
    ],
    "models/control/cartesian_impedance.py": ["tests/models/control/test_cartesian_impedance.py"],
    f"{HARDWARE}/src/guiderail_hardware/models/joint_status.py": [f"{HARDWARE}/tests/models/test_joint_status.py"],
    f"{HARDWARE}/src/guiderail_hardware/models/message_sequence.py": [
        f"{HARDWARE}/tests/models/test_message_sequence.py"
    ],
    f"{HARDWARE}/src/guiderail_hardware/models/round_trip.py": [f"{HARDWARE}/tests/models/test_round_trip.py"],
    f"{HARDWARE}/src/guiderail_hardware/models/state_estimator.py": [
        f"{HARDWARE}/tests/models/test_state_estimator.py"
    ],
    f"{HARDWARE}/src/guiderail_hardware/drivers/driver_guard.py": [f"{HARDWARE}/tests/drivers/test_driver_guard.py"],
    f"{HARDWARE}/src/guiderail_hardware/monitor.py": [f"{HARDWARE}/tests/drivers/test_monitor.py"],
    **{
        f"systems/{path.name}": [f"tests/systems/test_{name}.py" for name in _systems(path)]
        for path in sorted((ROOT / "systems").glob("*.py"))
        if path.stem != "__init__"
    },
    **{
        f"{HARDWARE}/src/guiderail_hardware/systems/{path.name}": [f"{HARDWARE}/tests/systems/test_{path.name}"]
        for path in sorted((ROOT / HARDWARE / "src/guiderail_hardware/systems").glob("*.py"))
        if path.stem != "__init__"
    },
    "packages/studies/src/guiderail_studies/certificate/checker.py": [
        "packages/studies/tests/certificate/test_certificate.py"
    ],
    "packages/lerobot/src/guiderail_lerobot/chunk_safety_limiter.py": [
        "packages/lerobot/tests/test_chunk_safety_limiter.py"
    ],
    "systems/support/last_valid.py": [
        "tests/systems/test_command_watchdog.py",
        "tests/systems/test_energy_tank.py",
        "tests/systems/test_cartesian_impedance_controller.py",
        f"{HARDWARE}/tests/systems/test_torque_safety_limiter.py",
    ],
}
SURVIVORS = ROOT / "tests" / "harness" / "mutation" / "survivors.yaml"
# Modules without mutants whose import is slow: imported before a process is forked for each mutant.
SLOW_IMPORTS = ("daqp", "hypothesis.extra.numpy", "mpmath", "numpy", "pydrake.math", "pytest")
SLOW_IMPORTS += (
    "scipy.optimize", "scipy.sparse", "scipy.spatial.transform", "sklearn.mixture", "yaml", "matplotlib.figure",
)  # fmt: skip
SLOW_IMPORTS += (
    "pydrake.multibody.plant",
    "pydrake.systems.analysis",
    "pydrake.systems.framework",
    "pydrake.systems.primitives",
)


# --- tests ---


def graft(file: str, tree: ast.Module) -> None:
    """Replace the code, defaults and constants of a file by those of `tree` in the modules of this process.

    The module cannot be imported again, because the tests have already imported it and its names.
    """
    module = _module(file)
    name, names = module.__name__, {"__name__": module.__name__, "__file__": str(ROOT / file)}
    exec(compile(tree, names["__file__"], "exec"), names)
    _graft_all(vars(module), {key: value for key, value in names.items() if not key.startswith("__")}, name)


def _module(file: str) -> ModuleType:
    """Return the imported module of a file of this tree."""
    module = next((each for each in list(sys.modules.values()) if _is_of(each, file)), None)
    if module is None:
        raise SystemExit(f"{file}: the tests import another copy of this file, or none: set PYTHONPATH to this tree")
    return module


def _is_of(module: object, file: str) -> bool:
    path = getattr(module, "__file__", None)
    return isinstance(path, str) and path.endswith(Path(file).name) and os.path.realpath(path) == str(ROOT / file)


def _graft_all(old: Mapping[str, Any], new: Mapping[str, Any], module: str, owner: type | None = None) -> None:
    for key, value in new.items():
        before, value = (_function(each) for each in (old.get(key), value))
        if isinstance(value, FunctionType) and isinstance(before, FunctionType) and value.__module__ == module:
            before.__code__ = value.__code__
            before.__defaults__ = _graft_defaults(before.__defaults__, value.__defaults__)
            previous, defaults = before.__kwdefaults__ or {}, value.__kwdefaults__ or {}
            before.__kwdefaults__ = {k: v if _is_numeric(v) else previous.get(k, v) for k, v in defaults.items()}
        elif isinstance(value, type) and isinstance(before, type) and value.__module__ == module:
            if not issubclass(value, Enum):
                _graft_all(vars(before), vars(value), module, before)
        elif owner is not None and isinstance(value, CONSTANTS):
            if not key.startswith("__") and not np.array_equal(value, before):
                setattr(owner, key, value)
        elif isinstance(value, CONSTANTS) and not np.array_equal(value, before):
            for user in list(sys.modules.values()):
                top = user.__name__.split(".")[0]
                # The package or a sibling, such as guiderail_hardware, or a test.
                if vars(user).get(key) is before and (top.startswith("guiderail") or top in TEST_MODULES):
                    setattr(user, key, value)


def _graft_defaults(before: tuple | None, after: tuple | None) -> tuple | None:
    """Return the defaults of a function, with numbers replaced by the numbers of a mutant."""
    if before is None or after is None or len(before) != len(after):
        return after
    return tuple(b if _is_numeric(b) else a for a, b in zip(before, after, strict=True))


def _is_numeric(value: Any) -> bool:
    """Return True for a number or a tuple of numbers."""
    return all(map(_is_numeric, value)) if isinstance(value, tuple) else isinstance(value, int | float)


def _function(value: Any) -> Any:
    """Return the function wrapped by a property, class method, static method or decorator."""
    for name in ("fget", "__func__", "func"):
        value = getattr(value, name) if isinstance(value, WRAPPERS) and hasattr(value, name) else value
    if isinstance(value, _CACHED):
        value.cache_clear()  # of results from before the mutation
    return unwrap(value) if isinstance(value, FunctionType | _CACHED) else value


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
    """Collect tests and call `work` with a mapping from their names to the tests."""
    quiet = ["-q", "--no-header", "--no-summary", "-p", "no:cacheprovider", "-p", "no:xdist", "-W", "ignore"]
    if pytest.main([*quiet, *tests], plugins=[_Session(work), *plugins]) != 0:
        raise SystemExit(f"{' '.join(tests)} cannot be collected")


def run(items: list[Any]) -> int:
    """Run tests until the first failure; return the index of the failed test, or -1 if all pass."""
    for index, item in enumerate(items):
        following = items[index + 1] if index + 1 < len(items) else None
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        if item.session.testsfailed:
            return index
    return -1


def _forked(work: Callable[[], Any], cpu_seconds: float, default: Any) -> Any:
    """Run `work` in a child process without output; return its result, or the default if the process is killed."""
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


def coverage(tests: list[str], items: dict[str, Any], recorder: _Coverage, store: Path) -> dict:
    """Return the lines that each test executes in each file, and the CPU time of each test, without mutations.

    Args:
        tests: Test files or folders.
        items: Tests by name.
        recorder: Plugin that records the coverage of the session.
        store: JSON file of earlier results, because a measurement takes longer than many mutants.
    """
    key = f"{' '.join(tests)} {_newest(tests)}"
    stored = json.loads(store.read_text()) if store.exists() else {}
    if key not in stored:

        def work():
            failed = run(list(items.values()))
            lines = {file: {test: sorted(n) for test, n in tested.items()} for file, tested in recorder.lines.items()}
            return {"lines": lines, "seconds": recorder.seconds, "failed": failed}

        stored[key] = _forked(work, 3600, {"failed": 0})
        if stored[key].pop("failed") >= 0:
            raise SystemExit(f"{' '.join(tests)} fails without a mutation: fix the code or the tests first")
        store.write_text(json.dumps(stored))
    return stored[key]


def _newest(tests: list[str]) -> float:
    """Return the time of the last change of a test or mutated file."""
    paths = [ROOT / test for test in tests] + [ROOT / file for file in TARGETS]
    files = [file for path in paths for file in (path.rglob("*.py") if path.is_dir() else [path])]
    return max(file.stat().st_mtime for file in files)


def killer(mutant: Mutant, items: dict[str, Any], covered: dict, kills: Counter[str], passing: set[tuple]) -> str:
    """Return the first test that fails with a mutant, or "" if all tests that execute its line pass.

    `passing` stores the sequences of tests that have passed with the unchanged file.
    """
    mutated, seconds = range(mutant.line, mutant.last_line + 1), covered["seconds"]
    lines = covered["lines"].get(mutant.file, {})
    executing = {test for test in seconds if any(line in mutated for line in lines.get(test, ()))}
    # Only the first test executes a shared fixture, and no test executes constants and defaults. Therefore all tests of
    # the test file with the same name are added, after those that execute the line.
    own = {f"test_{Path(mutant.file).stem}", *(Path(name).stem for name in TARGETS[mutant.file])}
    chosen = executing | {test for test in seconds if Path(test.split("::")[0]).stem in own}
    chosen = sorted(
        chosen or seconds, key=lambda test: (test not in executing, (seconds[test] + 1e-3) / (1.0 + kills[test]))
    )
    limit = 10 + 5 * sum(seconds[test] for test in chosen)
    failed = _first_failure(mutant.file, mutant.tree(), chosen, items, limit)
    if failed < 0:
        return ""
    # The killing test alone is enough if it fails alone, too, so that most sequences need not pass again.
    alone = _first_failure(mutant.file, mutant.tree(), chosen[failed : failed + 1], items, limit) >= 0
    sequence = tuple(chosen[failed : failed + 1] if alone else chosen[: failed + 1])
    if sequence not in passing:
        unchanged = ast.parse((ROOT / mutant.file).read_text())
        if _first_failure(mutant.file, unchanged, sequence, items, limit) >= 0:
            print(f"{mutant.file}: {', '.join(sequence)} fails without a mutation", file=sys.__stderr__, flush=True)
            raise SystemExit(1)
        passing.add(sequence)
    return sequence[-1]


def _first_failure(file: str, tree: ast.Module, tests: Sequence[str], items: dict[str, Any], limit: float) -> int:
    """Return the index of the first test that fails in a fork with the code of `tree`, -1 if all pass.

    If the process ends before a test has failed, in an import, by a crash or by the limit of CPU time, it is the last.
    """

    def work():
        graft(file, tree)
        return run([items[test] for test in tests])

    return _forked(work, limit, len(tests) - 1)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("files", nargs="*", help="names of files without .py (default: all)")
    parser.add_argument("--every", type=int, default=1, help="try one mutant of this many")
    parser.add_argument("--results", type=Path, help="JSON file of results; an interrupted run is resumed from it")
    parser.add_argument("--only", type=Path, help="try only the mutants in this JSON file of results")
    parser.add_argument("--again", action="store_true", help="try survivors again")
    arguments = parser.parse_args()
    if unknown := {*arguments.files} - {Path(file).stem for file in TARGETS}:
        parser.error(f"there is no file of the safety code called {min(unknown)}")
    os.chdir(ROOT)
    for name in SLOW_IMPORTS:
        importlib.import_module(name)
    with tempfile.TemporaryDirectory() as folder:
        results = arguments.results.absolute() if arguments.results else Path(folder) / "mutants.json"
        files = [file for file in TARGETS if not arguments.files or Path(file).stem in arguments.files]
        only = json.loads(arguments.only.read_text()) if arguments.only else None
        counts = []
        for file in files if only is None else [file for file in files if file in only]:
            is_chosen = (lambda mutant: mutant.is_in_sample(arguments.every)) if only is None else _named(only[file])
            counts.append(try_file(file, is_chosen, results, arguments.again))
        problems, total, killed = np.sum(counts, 0)
    print(f"total: {killed} of {total} killed ({killed / max(total, 1):.1%}); {problems} to be explained or fixed")
    return min(int(problems), 1)


def _named(names: Collection[str]) -> Callable[[Mutant], bool]:
    return lambda mutant: mutant.name in names


def try_mutants(file: str, sample: list[Mutant], store: Path, again: bool) -> None:
    """Try the mutants of a file that have no result yet, in a process that has collected its tests."""
    stored = json.loads(store.read_text()) if store.exists() else {}
    results, reasons = stored.setdefault(file, {}), _reasons(file)
    recorder, kills, passing = _Coverage(), Counter[str](), set[tuple]()

    def work(items):
        covered = coverage(TARGETS[file], items, recorder, store.with_suffix(".coverage"))
        for mutant in sample:
            if mutant.name in results and not (again and results[mutant.name] == "survived"):
                continue
            test = killer(mutant, items, covered, kills, passing)
            kills[test] += 1
            results[mutant.name] = f"killed by {test}" if test else "survived"
            if not test and mutant.name not in reasons:
                print(f"{file}:{mutant.line}: survives: {mutant.name}", file=sys.__stderr__, flush=True)
            store.write_text(json.dumps(stored, indent=1, ensure_ascii=False))

    with_tests(TARGETS[file], work, [recorder])


def _reasons(file: str) -> dict[str, str]:
    return yaml.safe_load(SURVIVORS.read_text()).get(file, {})


def try_file(file: str, is_chosen: Callable[[Mutant], bool], store: Path, again: bool) -> tuple[int, int, int]:
    """Try the chosen mutants of a file; return the numbers of problems, of mutants, and of killed mutants.

    Problems are unexplained survivors and stale explanations.
    """
    all_mutants, reasons = mutants(file), _reasons(file)
    sample = [mutant for mutant in all_mutants if is_chosen(mutant)]
    child = os.fork()
    if child == 0:
        status = 1
        try:
            try_mutants(file, sample, store, again)
            status = 0
        finally:
            os._exit(status)
    if os.waitpid(child, 0)[1]:
        raise SystemExit(f"{file}: the mutants could not be tried")
    results = json.loads(store.read_text())[file] if store.exists() else {}
    survivors = {mutant.name for mutant in sample if results[mutant.name] == "survived"}
    killed = {mutant.name for mutant in sample} - survivors
    stale = (set(reasons) - {mutant.name for mutant in all_mutants}) | (killed & set(reasons))
    for name in sorted(stale):
        print(f"{file}: explanation without a survivor: {name}", flush=True)
    explained = len(survivors & set(reasons))
    unexplained = len(survivors) - explained
    counts = f"{len(killed)} of {len(sample)} killed, {explained} explained, {unexplained} not explained"
    print(f"{file}: {counts}", flush=True)
    return unexplained + len(stale), len(sample), len(killed)


if __name__ == "__main__":
    sys.exit(main())
