"""Random mutations of bytes, texts, and trees of lists and mappings."""

import copy

from hypothesis import strategies as st


@st.composite
def edits(draw, max_size=6):
    """Draw mutations of a byte string: relative position, number of removed bytes, and inserted bytes."""
    return [
        (draw(st.floats(0, 1)), draw(st.sampled_from([0, 0, 1, 1, 2, 4, 8, 50])), draw(st.binary(max_size=8)))
        for _ in range(draw(st.integers(1, max_size)))
    ]


def edited(data: bytes, changes) -> bytes:
    """Return `data` with the mutations drawn by `edits`."""
    for position, removed, inserted in changes:
        start = int(position * len(data))
        data = data[:start] + inserted + data[start + removed :]
    return data


def bit_flips(max_size=2):
    """Return a strategy for bits to invert: relative position of the byte, and number of the bit."""
    return st.lists(st.tuples(st.floats(0, 1), st.integers(0, 7)), max_size=max_size)


def flipped(data: bytes, flips) -> bytes:
    """Return `data` with the bits drawn by `bit_flips` inverted."""
    data = bytearray(data)
    for position, bit in flips:
        data[min(int(position * len(data)), len(data) - 1)] ^= 1 << bit
    return bytes(data)


UNUSUAL_VALUES = st.sampled_from(
    [None, True, 0, -1, 1, 2, 7, 1e-12, 1e-300, 0.1, 90, 180, 360.0, -180, 1e6, 1e300, 10**400, float("nan")]
    + [
        "", "p", "p * 2", "-p", "1 / 0", "1 / p", "1e5", "x", "world", "tool", "a", "far", "near", "one", "cup",
        "uneven",
    ]
    + ["(" * 90, "()", "[0]", "1_0", "0x2", "1j", "True", "p.real", "p()", "\n", "\x85", "ﬁ", "a" * 150, "9" * 199]
    + [[], [0], [0, 0, 1], [0, 0, 0], [1, 2, 3, 4], [[0, 0, 1]], [[]], [None], ["p", "q", 1], {}, {"kind": "box"}]
)  # fmt: skip


def paths_in(tree, path=()):
    """Yield every path in a tree of lists and mappings."""
    yield path
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in entries:
        yield from paths_in(value, (*path, key))


def entry_at(tree, path):
    """Return the entry of a tree at a path."""
    for key in path:
        tree = tree[key]
    return tree


@st.composite
def changed_trees(draw, trees):
    """Draw a tree with up to three changed entries."""
    tree = copy.deepcopy(draw(st.sampled_from(trees)))
    for _ in range(draw(st.integers(0, 3))):
        paths = [path for path in paths_in(tree) if path]
        path = draw(st.sampled_from(paths))
        parent, key = entry_at(tree, path[:-1]), path[-1]
        action = draw(st.sampled_from(["unusual", "unusual", "number", "number", "remove", "copy", "rename", "append"]))
        if action == "unusual":
            parent[key] = copy.deepcopy(draw(UNUSUAL_VALUES))
        elif action == "number":
            numbers = [p for p in paths if type(entry_at(tree, p)) in (int, float)]
            path = draw(st.sampled_from(numbers or paths))
            entry_at(tree, path[:-1])[path[-1]] = draw(st.floats(-1e7, 1e7) | st.integers(-400, 400))
        elif action == "remove":
            del parent[key]
        elif action == "copy":
            parent[key] = copy.deepcopy(entry_at(tree, draw(st.sampled_from(paths))))
        elif action == "rename" and isinstance(parent, dict):
            name = draw(st.sampled_from(["name", "kind", "frame", "to", "inputs", "far", "x", 1, None]))
            parent[name] = parent.pop(key)
        elif action == "append" and isinstance(parent, list):
            parent.append(copy.deepcopy(parent[key]))
        if not any(paths_in(tree)):
            break
    return tree


PIECES = st.sampled_from(
    [
        " ", "  ", "\n", "\n  ", ":", ": ", "- ", "-", ",", "[", "]", "{", "}", "&a ", "*a", "<<: *a", "#", "'", '"',
        "|", ">",
    ]
    + [
        "?",
        "!",
        "!!int ",
        "%",
        "@",
        "0",
        "1",
        "-1",
        "e5",
        ".",
        "..",
        "*",
        "/",
        "+",
        "_",
        "x",
        "p",
        "é",
        "\t",
        "\x00",
        "~",
    ]
    + ["null", "true", "yes", "---", "...", "\ufeff", "1e309", "0.5", "010", "1:30"]
)  # fmt: skip


@st.composite
def changed_texts(draw, texts):
    """Draw a text with up to four changes of characters or lines."""
    text = draw(st.sampled_from(texts))
    for _ in range(draw(st.integers(1, 4))):
        start = int(draw(st.floats(0, 1)) * len(text))
        removed = draw(st.sampled_from([0, 0, 1, 1, 2, 5, 40]))
        action = draw(st.sampled_from(["insert", "insert", "remove", "line", "digit"]))
        if action == "line":
            start = text.rfind("\n", 0, start) + 1
            end = text.find("\n", start) + 1 or len(text)
            text = text[:end] + text[start:end] + text[end:] if removed else text[:start] + text[end:]
        elif action == "digit":
            digits = [i for i, letter in enumerate(text) if letter.isdigit()]
            start = digits[min(int(draw(st.floats(0, 1)) * len(digits)), len(digits) - 1)]
            text = text[:start] + str(draw(st.integers(0, 9))) + text[start + 1 :]
        else:
            text = text[:start] + (draw(PIECES) if action == "insert" else "") + text[start + removed :]
    return text
