"""Mutation testing of the safety code.

    python tests/harness/mutation/mutate.py                         # all mutants, hours
    python tests/harness/mutation/mutate.py --every 8               # an eighth of them, by hashes of the names
    python tests/harness/mutation/mutate.py qp window               # of these files
    python tests/harness/mutation/mutate.py --results mutants.json  # resumes an interrupted run

Every operator below is applied wherever it fits: comparisons, arithmetic, logic, numbers, branches, statements, calls
with a counterpart, slices, keyword arguments. A mutant is tried with the tests that execute its line, fastest first.
A mutant that passes them survives. `survivors.yaml` explains why a survivor makes no difference. A survivor without an
explanation is an error, and so is an explanation without a surviving mutant.
"""

from __future__ import annotations

import argparse
import ast
import copy
import hashlib
import importlib
import importlib.abc
import importlib.util
import json
import os
import resource
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

ROOT = Path(__file__).parents[3]
PRIMITIVES = ["tests/models/primitives"]
TEMPLATES = ["tests/models/templates"]
TARGETS = {
    **{f"models/primitives/{name}.py": PRIMITIVES for name in ("qp", "window", "lc_ns_kmp", "constraints")},
    **{f"models/primitives/{name}.py": PRIMITIVES for name in ("gains", "features", "kernels", "kmp")},
    **{f"models/primitives/{name}.py": PRIMITIVES for name in ("poses", "reference", "demonstrations")},
    "models/templates/constraints.py": TEMPLATES,
    "models/templates/template.py": TEMPLATES,
    "models/templates/geometry.py": TEMPLATES,
    "models/control/keep_out.py": [
        "tests/models/control/test_keep_out.py",
        "tests/models/control/test_keep_out_properties.py",
    ],
    "models/control/cartesian_impedance.py": [
        "tests/models/control/test_cartesian_impedance.py",
        "tests/models/control/test_reachable_inertia.py",
    ],
    "models/control/joint_status.py": ["tests/models/control/test_joint_status.py"],
    "models/control/state_estimator.py": ["tests/models/control/test_state_estimator.py"],
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


# --- mutations ---

ORDER = {
    ast.Lt: (ast.LtE, ast.Gt),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
ARITHMETIC = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitOr: ast.BitAnd,
    ast.BitAnd: ast.BitOr,
}
COUNTERPART = {
    **{"min": "max", "any": "all", "minimum": "maximum", "argmin": "argmax", "sin": "cos", "zeros": "ones"},
    **{"max": "min", "all": "any", "maximum": "minimum", "argmax": "argmin", "cos": "sin", "ones": "zeros"},
    **{"radians": "degrees", "deg2rad": "rad2deg", "sum": "max", "mean": "max", "asin": "sin", "flatnonzero": "argmin"},
}
# Calls that are replaced by their argument.
DROPPED = {"abs", "sqrt", "copy", "sorted", "float", "int", "bool", "round", "array", "asarray", "ascontiguousarray"}


def changes(node: ast.AST) -> Iterator[ast.AST | None]:
    """Yield the mutations of a node; None removes a statement."""
    if isinstance(node, ast.Compare) and len(node.ops) >= 1:
        for i, operator in enumerate(node.ops):
            for other in ORDER[type(operator)]:
                yield _with(node, ops=[*node.ops[:i], other(), *node.ops[i + 1 :]])
    elif isinstance(node, ast.BinOp) and type(node.op) in ARITHMETIC:
        yield _with(node, op=ARITHMETIC[type(node.op)]())
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
        yield _with(node, left=node.right, right=node.left)
    elif isinstance(node, ast.AugAssign):
        if type(node.op) in ARITHMETIC:
            yield _with(node, op=ARITHMETIC[type(node.op)]())
        yield None
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
        yield node.operand
    elif isinstance(node, ast.BoolOp):
        yield _with(node, op=ast.Or() if isinstance(node.op, ast.And) else ast.And())
    elif isinstance(node, ast.Constant):
        yield from (ast.copy_location(ast.Constant(value), node) for value in _other_constants(node.value))
    elif isinstance(node, ast.If | ast.While | ast.IfExp):
        yield from (_with(node, test=ast.copy_location(ast.Constant(value), node.test)) for value in (True, False))
    elif isinstance(node, ast.Call):
        yield from _other_calls(node)
    elif isinstance(node, ast.Attribute) and node.attr == "T" and isinstance(node.ctx, ast.Load):
        yield node.value
    elif isinstance(node, ast.Slice):
        yield from (_with(node, **{end: None}) for end in ("lower", "upper", "step") if getattr(node, end))
    elif isinstance(node, ast.Continue | ast.Break):
        yield ast.copy_location(ast.Break() if isinstance(node, ast.Continue) else ast.Continue(), node)
    elif _can_be_removed(node):
        yield None


def _can_be_removed(node: ast.AST) -> bool:
    """Return True for a statement that the following ones do not need."""
    if isinstance(node, ast.Assign):
        return not any(isinstance(target, ast.Name | ast.Tuple) for target in node.targets)
    return isinstance(node, ast.Raise) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Call))


def _other_constants(value):
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value + 1, value - 1]
    if isinstance(value, float):
        return [100 * value, value / 100] if value else [1.0]
    return []


def _other_calls(node: ast.Call) -> Iterator[ast.AST]:
    called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    if called in COUNTERPART:
        func = copy.deepcopy(node.func)
        setattr(func, "attr" if isinstance(func, ast.Attribute) else "id", COUNTERPART[called])
        yield _with(node, func=func)
    if called in DROPPED and node.args:
        yield node.args[0]
    elif called in DROPPED and isinstance(node.func, ast.Attribute):
        yield node.func.value
    for i in range(len(node.keywords)):
        yield _with(node, keywords=node.keywords[:i] + node.keywords[i + 1 :])


def _with(node: ast.AST, **fields) -> ast.AST:
    other = copy.copy(node)
    for name, value in fields.items():
        setattr(other, name, value)
    return other


Path_ = tuple[tuple[str, int | None], ...]


@dataclass(frozen=True)
class Mutant:
    """Mutation of a file, with a name that does not depend on line numbers."""

    file: str
    name: str
    line: int
    last_line: int
    path: Path_
    change: int

    def tree(self) -> ast.Module:
        """Return the syntax tree of the mutated file."""
        tree = ast.parse((ROOT / self.file).read_text())
        _replace(tree, self.path, list(changes(_at(tree, self.path)))[self.change])
        return ast.fix_missing_locations(tree)

    def is_in_sample(self, every: int) -> bool:
        """Return True if the mutant is in the reproducible sample of one in `every`."""
        return int.from_bytes(hashlib.sha256(f"{self.file}: {self.name}".encode()).digest()[:8], "big") % every == 0


def mutants(file: str) -> list[Mutant]:
    """Return the mutants of a file in the order of its lines."""
    tree = ast.parse((ROOT / file).read_text())
    found, seen = [], Counter()
    for path in list(_places(tree)):
        for i, _ in enumerate(changes(_at(tree, path))):
            depth = _depth_of_statement(tree, path)
            before = _at(tree, path[:depth])
            mutated = ast.Module([copy.deepcopy(before)], [])
            inside = (("body", 0), *path[depth:])
            _replace(mutated, inside, list(changes(_at(mutated, inside)))[i])
            name = f"{_function(tree, path)}: {_difference(_source(before), _source(mutated.body[0]))}"
            seen[name] += 1
            if seen[name] > 1:
                name += f" ({seen[name]})"
            found.append(Mutant(file, name, before.lineno, before.end_lineno or before.lineno, path, i))
    return found


def _places(node: ast.AST, path: Path_ = ()) -> Iterator[Path_]:
    """Yield the paths of all code nodes: no docstrings, annotations, decorators, messages or imports."""
    yield path
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "ctx", "ops", "op", "bases"):
            continue
        if isinstance(node, ast.Raise | ast.Import | ast.ImportFrom | ast.JoinedStr):
            continue
        if isinstance(value, ast.AST):
            yield from _places(value, (*path, (field, None)))
        elif isinstance(value, list):
            for i, entry in enumerate(value):
                if isinstance(entry, ast.AST):
                    yield from _places(entry, (*path, (field, i)))


def _at(node, path: Path_):
    for field, i in path:
        node = getattr(node, field) if i is None else getattr(node, field)[i]
    return node


def _replace(tree: ast.Module, path: Path_, new: ast.AST | None) -> None:
    holder, (field, i) = _at(tree, path[:-1]), path[-1]
    if new is None:
        new = ast.copy_location(ast.Pass(), _at(tree, path))
    if i is None:
        setattr(holder, field, new)
    else:
        getattr(holder, field)[i] = new


def _depth_of_statement(tree: ast.Module, path: Path_) -> int:
    """Return the length of the path to the innermost statement around a node."""
    return next(n for n in range(len(path), -1, -1) if isinstance(_at(tree, path[:n]), ast.stmt))


def _source(statement: ast.stmt) -> str:
    """Return the source of a statement, of a block only its head."""
    head = copy.copy(statement)
    if hasattr(head, "body"):
        head.body = [ast.Pass()]
        head.orelse = [] if hasattr(head, "orelse") else None
    if hasattr(head, "decorator_list"):
        head.decorator_list = []
    return " ".join(ast.unparse(head).removesuffix("pass").split()).removesuffix(":")


def _function(tree: ast.Module, path: Path_) -> str:
    """Return the function or class around a node."""
    around = [_at(tree, path[:n]) for n in range(len(path))]
    return ".".join(node.name for node in around if isinstance(node, ast.FunctionDef | ast.ClassDef)) or "module"


def _difference(before: str, after: str, context: int = 30) -> str:
    """Return the difference between two lines, with context."""
    start = _common(before, after)
    end = _common(before[start:][::-1], after[start:][::-1])
    left, right = before[max(0, start - context) : start], before[len(before) - end :][:context]
    return f"`{left}⟨{before[start : len(before) - end]} → {after[start : len(after) - end]}⟩{right}`"


def _common(a: str, b: str) -> int:
    """Return the length of the common prefix of two texts."""
    return next((i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))


# --- tests ---


class _Mutated(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Importer that replaces a module by its mutant."""

    def __init__(self, mutant: Mutant):
        self.name = "guiderail." + mutant.file.removesuffix(".py").replace("/", ".")
        self.mutant = mutant

    def find_spec(self, fullname, path=None, target=None):
        return importlib.util.spec_from_loader(fullname, self) if fullname == self.name else None

    def exec_module(self, module):
        module.__file__ = str(ROOT / self.mutant.file)
        exec(compile(self.mutant.tree(), module.__file__, "exec"), module.__dict__)


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


def _pytest(arguments: list[str], plugins=()) -> int:
    import pytest

    quiet = ["-q", "-x", "--no-header", "--no-summary", "-p", "no:cacheprovider", "-p", "no:xdist", "-W", "ignore"]
    return int(pytest.main([*quiet, *arguments], plugins=list(plugins)))


def _forked(work, cpu_seconds: float) -> int:
    """Run `work` in a silent child process with limits; return its exit status."""
    child = os.fork()
    if child == 0:
        silent = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silent, 1)
        os.dup2(silent, 2)
        resource.setrlimit(resource.RLIMIT_CPU, (int(cpu_seconds), int(cpu_seconds) + 5))
        resource.setrlimit(resource.RLIMIT_AS, (8 * 2**30, 8 * 2**30))
        status = 3
        try:
            status = work()
        finally:
            os._exit(status)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status)


def coverage(tests: list[str], store: Path) -> dict:
    """Return the lines of each file that each test executes and the CPU time of each test, without mutations.

    Args:
        tests: Test files or folders.
        store: JSON file in which results are stored, because measuring takes longer than many mutants.
    """
    key = f"{' '.join(tests)} {_newest(tests)}"
    kept = json.loads(store.read_text()) if store.exists() else {}
    if key not in kept:

        def work():
            watcher = _Coverage()
            status = _pytest(tests, [watcher])
            lines = {file: {test: sorted(n) for test, n in of.items()} for file, of in watcher.lines.items()}
            store.write_text(json.dumps(kept | {key: {"lines": lines, "seconds": watcher.seconds}}))
            return status

        status = _forked(work, 3600)
        if status != 0:
            raise SystemExit(f"{' '.join(tests)} fails without a mutation (status {status}): fix it first")
        kept = json.loads(store.read_text())
    return kept[key]


def _newest(tests: list[str]) -> float:
    """Return the time of the last change of the tests or of mutated files."""
    places = [ROOT / test for test in tests] + [ROOT / file for file in TARGETS]
    files = [file for place in places for file in (place.rglob("*.py") if place.is_dir() else [place])]
    return max(file.stat().st_mtime for file in files)


def survives(mutant: Mutant, covered: dict) -> bool:
    """Return True if every test that executes the mutated line passes."""
    here, seconds = range(mutant.line, mutant.last_line + 1), covered["seconds"]
    lines = covered["lines"].get(mutant.file, {})
    chosen = {test for test in seconds if any(line in here for line in lines.get(test, ()))}
    # Only the first test executes a shared fixture, and no test executes constants and defaults.
    chosen |= {test for test in seconds if Path(test.split("::")[0]).stem == f"test_{Path(mutant.file).stem}"}
    chosen = sorted(chosen or seconds, key=lambda test: seconds[test])
    limit = 10 + 5 * sum(seconds[test] for test in chosen)

    def work():
        sys.meta_path.insert(0, _Mutated(mutant))
        return _pytest(chosen)

    return _forked(work, limit) == 0


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


def try_file(file: str, every: int, kept: Path, again: bool) -> tuple[int, int, int]:
    """Return the numbers of unexplained survivors and stale explanations, of mutants, and of killed mutants."""
    tried = json.loads(kept.read_text()) if kept.exists() else {}
    results, reasons = tried.setdefault(file, {}), yaml.safe_load(SURVIVORS.read_text()).get(file, {})
    everything = mutants(file)
    found = [mutant for mutant in everything if mutant.is_in_sample(every)]
    for mutant in found:
        if mutant.name in results and not (again and results[mutant.name] == "survived"):
            continue
        covered = coverage(TARGETS[file], kept.with_suffix(".coverage"))
        results[mutant.name] = "survived" if survives(mutant, covered) else "killed"
        if results[mutant.name] == "survived" and mutant.name not in reasons:
            print(f"{file}:{mutant.line}: survives: {mutant.name}", flush=True)
        kept.write_text(json.dumps(tried, indent=1, ensure_ascii=False))
    survivors = {mutant.name for mutant in found if results[mutant.name] == "survived"}
    killed = {mutant.name for mutant in found} - survivors
    stale = (set(reasons) - {mutant.name for mutant in everything}) | (killed & set(reasons))
    for name in sorted(stale):
        print(f"{file}: explained, but not a survivor: {name}", flush=True)
    known = len(survivors & set(reasons))
    print(f"{file}: {len(killed)} of {len(found)} killed, {known} explained, {len(survivors) - known} not", flush=True)
    return len(survivors) - known + len(stale), len(found), len(killed)


if __name__ == "__main__":
    sys.exit(main())
