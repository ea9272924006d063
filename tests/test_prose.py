"""Rules for the prose of docstrings, comments, help texts and pages."""

import ast
import io
import re
import subprocess
import tokenize
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FIRST_WORD = r"(Of|What|How|Where|Whether|Who|Whoever|That)\b"
FRAGMENT = re.compile(rf"{FIRST_WORD}(?![^.]*\?)")  # a question is no fragment
WORD = re.compile(r"\b(whoever|nobody|somebody|anew)\b", re.IGNORECASE)
CHECKED = (
    *("CONTRIBUTING.md", "README.md", "diagrams/", "docs/", "examples/", "models/", "packages/", "research/", "src/"),
    *("systems/", "tests/", "tools/"),
)
HELP_CALLS = {"Option", "Argument", "add_argument", "Field", "opt", "arg"}  # their text arguments are help texts
NOT_CHECKED = ("CHANGELOG.md", "docs/changelog.md", "tests/models/", "tests/test_prose.py")


def tracked(*endings):
    """Return the checked files with one of the endings that git does not ignore."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    files = [ROOT / name for name in names if name.endswith(endings) and name.startswith(CHECKED)]
    return [path for path in files if path.is_file() and not str(path.relative_to(ROOT)).startswith(NOT_CHECKED)]


def containing(pattern, *endings):
    """Yield path and text of each checked file in which the pattern occurs, because parsing all files takes seconds."""
    for path in tracked(*endings):
        text = path.read_text(encoding="utf-8")
        if pattern.search(text):
            yield path, text


def docstrings(tree):
    """Yield line and text of every docstring."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield node.body[0].lineno, text


def help_texts(tree):
    """Yield line and text of the string arguments of calls that declare options."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in HELP_CALLS:
            for argument in [*node.args, *(keyword.value for keyword in node.keywords)]:
                if isinstance(argument, ast.Constant) and isinstance(argument.value, str):
                    yield argument.lineno, argument.value


def comments(source):
    """Yield line and text of every comment."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string


def report(violations):
    """Return a message with the number of violations of each word and the list of all violations."""
    counts = ", ".join(f"{count} × {word}" for word, count in Counter(word for _, _, word in violations).most_common())
    return "\n".join([f"{len(violations)}: {counts}", *(f"{path}:{line}: {word}" for path, line, word in violations)])


def test_no_docstring_begins_with_a_fragment():
    violations = []
    for path, source in containing(re.compile(rf"""["']\s*{FIRST_WORD}"""), ".py"):
        for line, text in docstrings(ast.parse(source)):
            if result := FRAGMENT.match(text):
                violations.append((path.relative_to(ROOT), line, result[1]))
    assert not violations, report(violations)


def test_docstrings_comments_and_help_have_no_banned_words():
    violations = []
    for path, source in containing(WORD, ".py"):
        tree = ast.parse(source)
        for line, text in (*docstrings(tree), *help_texts(tree), *comments(source)):
            for offset, part in enumerate(text.splitlines()):
                violations += [(path.relative_to(ROOT), line + offset, word.lower()) for word in WORD.findall(part)]
    assert not violations, report(violations)


def test_pages_have_no_banned_words():
    violations = []
    for path, page in containing(WORD, ".md"):
        for line, text in enumerate(page.splitlines(), 1):
            violations += [(path.relative_to(ROOT), line, word.lower()) for word in WORD.findall(text)]
    assert not violations, report(violations)


@pytest.mark.parametrize(
    ("text", "is_fragment"),
    [("Whether it is so.", True), ("What is known.", True), ("Whatever.", False), ("Return what is known.", False)],
)
def test_fragment_is_found_at_the_beginning(text, is_fragment):
    assert (FRAGMENT.match(text) is not None) == is_fragment
