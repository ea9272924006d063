"""Mutations of Python code: operators, and mutants with names that do not depend on line numbers."""

from __future__ import annotations

import ast
import copy
import hashlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[3]

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
# Calls that are replaced by their argument. Conversions of a number's type are left out: NumPy's numbers behave like
# Python's.
DROPPED = {"abs", "sqrt", "copy", "sorted", "round", "array", "asarray"}
# Keyword arguments that are not removed: they only reduce evaluations by Drake, check a length, or choose a type.
KEPT_KEYWORDS = {"prerequisites_of_calc", "strict", "dtype"}
LIMITS = ast.Lt | ast.LtE | ast.Gt | ast.GtE


def changes(node: ast.AST) -> Iterator[ast.AST | None]:
    """Yield the mutations of a node; None removes a statement."""
    if isinstance(node, ast.Compare) and len(node.ops) >= 1:
        for i, operator in enumerate(node.ops):
            for replacement in ORDER[type(operator)]:
                yield _with(node, ops=[*node.ops[:i], replacement(), *node.ops[i + 1 :]])
            left, right = ([node.left, *node.comparators][j] for j in (i, i + 1))
            # Scaling `right` has no effect if `right` is infinite, or if `left` is zero and no finite limit follows:
            # only the sign of `right` matters then.
            following = [ast.unparse(comparator) for comparator in node.comparators[i : i + 2]]
            is_zero = isinstance(left, ast.Constant) and left.value == 0
            has_no_effect = following[0] == "np.inf" or (is_zero and following[1:] in ([], ["np.inf"]))
            if isinstance(operator, LIMITS) and not has_no_effect and not isinstance(right, ast.Constant | ast.UnaryOp):
                wider = ast.copy_location(ast.BinOp(right, ast.Mult(), ast.Constant(1.001)), right)
                yield _with(node, comparators=[*node.comparators[:i], wider, *node.comparators[i + 1 :]])
    elif isinstance(node, ast.BinOp) and type(node.op) in ARITHMETIC:
        yield _with(node, op=ARITHMETIC[type(node.op)]())
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
        if ast.unparse(node.left) != ast.unparse(node.right):
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
        yield from (ast.copy_location(ast.Constant(value), node) for value in _changed_constants(node.value))
    elif isinstance(node, ast.If | ast.While | ast.IfExp):
        yield from (_with(node, test=ast.copy_location(ast.Constant(value), node.test)) for value in (True, False))
    elif isinstance(node, ast.Call):
        yield from _changed_calls(node)
    elif isinstance(node, ast.Attribute) and node.attr == "T" and isinstance(node.ctx, ast.Load):
        yield node.value
    elif isinstance(node, ast.Slice):
        yield from (_with(node, **{end: None}) for end in ("lower", "upper", "step") if getattr(node, end))
    elif isinstance(node, ast.Continue | ast.Break):
        yield ast.copy_location(ast.Break() if isinstance(node, ast.Continue) else ast.Continue(), node)
    elif _can_be_removed(node):
        yield None


def _can_be_removed(node: ast.AST) -> bool:
    """Return True for a statement that defines no name for the following statements."""
    if isinstance(node, ast.Assign):
        return not any(isinstance(target, ast.Name | ast.Tuple) for target in node.targets)
    return isinstance(node, ast.Raise) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Call))


def _changed_constants(value):
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value + 1, value - 1]
    if isinstance(value, float):
        return [100 * value, 1.001 * value] if value else [1.0]
    return []


def _changed_calls(node: ast.Call) -> Iterator[ast.AST]:
    called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    if called in COUNTERPART:
        func = copy.deepcopy(node.func)
        setattr(func, "attr" if isinstance(func, ast.Attribute) else "id", COUNTERPART[called])
        yield _with(node, func=func)
    if called == "isfinite" and node.args:
        func = ast.Attribute(ast.Name("np", ast.Load()), "logical_not", ast.Load())
        isnan = ast.Attribute(ast.Name("np", ast.Load()), "isnan", ast.Load())
        yield ast.copy_location(ast.Call(func, [ast.Call(isnan, node.args, [])], []), node)
    if called in DROPPED and node.args:
        yield node.args[0]
    elif called in DROPPED and isinstance(node.func, ast.Attribute):
        yield node.func.value
    for i in range(len(node.keywords)):
        if node.keywords[i].arg not in KEPT_KEYWORDS:
            yield _with(node, keywords=node.keywords[:i] + node.keywords[i + 1 :])


def _with(node: ast.AST, **fields) -> ast.AST:
    changed = copy.copy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed


NodePath = tuple[tuple[str, int | None], ...]


@dataclass(frozen=True)
class Mutant:
    """Mutation of a file, with a name that does not depend on line numbers."""

    file: str
    name: str
    line: int
    last_line: int
    path: NodePath
    change: int  # index of the mutation among those of the node

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
    result, seen = [], Counter()
    for path in list(_node_paths(tree)):
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
            result.append(Mutant(file, name, before.lineno, before.end_lineno or before.lineno, path, i))
    return result


def _node_paths(node: ast.AST, path: NodePath = ()) -> Iterator[NodePath]:
    """Yield the paths of all nodes except those of annotations, decorators, messages, imports and enumerations.

    The index of a port's value is left out as well, because most ports have one entry.
    """
    if isinstance(node, ast.ClassDef) and any("Enum" in ast.unparse(base) for base in node.bases):
        return
    yield path
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "ctx", "ops", "op", "bases"):
            continue
        if isinstance(node, ast.Raise | ast.Import | ast.ImportFrom | ast.JoinedStr):
            continue
        if field == "slice" and ".Eval(" in ast.unparse(node.value):
            continue
        if isinstance(value, ast.AST):
            yield from _node_paths(value, (*path, (field, None)))
        elif isinstance(value, list):
            for i, entry in enumerate(value):
                if isinstance(entry, ast.AST):
                    yield from _node_paths(entry, (*path, (field, i)))


def _at(node, path: NodePath):
    for field, i in path:
        node = getattr(node, field) if i is None else getattr(node, field)[i]
    return node


def _replace(tree: ast.Module, path: NodePath, new: ast.AST | None) -> None:
    parent, (field, i) = _at(tree, path[:-1]), path[-1]
    if new is None:
        new = ast.copy_location(ast.Pass(), _at(tree, path))
    if i is None:
        setattr(parent, field, new)
    else:
        getattr(parent, field)[i] = new


def _depth_of_statement(tree: ast.Module, path: NodePath) -> int:
    """Return the length of the path to the innermost statement that contains a node."""
    return next(n for n in range(len(path), -1, -1) if isinstance(_at(tree, path[:n]), ast.stmt))


def _source(statement: ast.stmt) -> str:
    """Return the source of a statement without the body of a compound statement."""
    head = copy.copy(statement)
    if hasattr(head, "body"):
        head.body = [ast.Pass()]
        head.orelse = [] if hasattr(head, "orelse") else None
    if hasattr(head, "decorator_list"):
        head.decorator_list = []
    return " ".join(ast.unparse(head).removesuffix("pass").split()).removesuffix(":")


def _function(tree: ast.Module, path: NodePath) -> str:
    """Return the qualified name of the function or class that contains a node; "module" outside of both."""
    parents = [_at(tree, path[:n]) for n in range(len(path))]
    return ".".join(node.name for node in parents if isinstance(node, ast.FunctionDef | ast.ClassDef)) or "module"


def _difference(before: str, after: str, context: int = 30) -> str:
    """Return the difference between two lines with `context` characters on each side."""
    start = _common(before, after)
    end = _common(before[start:][::-1], after[start:][::-1])
    left, right = before[max(0, start - context) : start], before[len(before) - end :][:context]
    return f"`{left}⟨{before[start : len(before) - end]} → {after[start : len(after) - end]}⟩{right}`"


def _common(a: str, b: str) -> int:
    """Return the length of the common prefix of two texts."""
    return next((i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))
