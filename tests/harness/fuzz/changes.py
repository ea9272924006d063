"""Random mutations of bytes, texts, and trees of lists and mappings."""

import copy

from hypothesis import strategies as st


@st.composite
def edits(draw, max_size=6):
    """Draw mutations of a byte string: position, number of removed bytes, and inserted bytes."""
    return [
        (draw(st.floats(0, 1)), draw(st.sampled_from([0, 0, 1, 1, 2, 4, 8, 50])), draw(st.binary(max_size=8)))
        for _ in range(draw(st.integers(1, max_size)))
    ]


def edited(data: bytes, changes) -> bytes:
    for position, removed, inserted in changes:
        at = int(position * len(data))
        data = data[:at] + inserted + data[at + removed :]
    return data


ODD = st.sampled_from(
    [None, True, 0, -1, 1, 2, 7, 1e-12, 1e-300, 0.1, 90, 180, 360.0, -180, 1e6, 1e300, 10**400, float("nan")]
    + [
        "",
        "p",
        "p * 2",
        "-p",
        "1 / 0",
        "1 / p",
        "1e5",
        "x",
        "world",
        "tool",
        "a",
        "far",
        "near",
        "one",
        "cup",
        "scaled",
    ]
    + ["(" * 90, "()", "[0]", "1_0", "0x2", "1j", "True", "p.real", "p()", "\n", "\x85", "ﬁ", "a" * 150, "9" * 199]
    + [[], [0], [0, 0, 1], [0, 0, 0], [1, 2, 3, 4], [[0, 0, 1]], [[]], [None], ["p", "q", 1], {}, {"kind": "arc"}]
)


def places(tree, path=()):
    """Yield every path in a tree of lists and mappings."""
    yield path
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in entries:
        yield from places(value, (*path, key))


def get(tree, path):
    for key in path:
        tree = tree[key]
    return tree


@st.composite
def changed_trees(draw, trees):
    tree = copy.deepcopy(draw(st.sampled_from(trees)))
    for _ in range(draw(st.integers(0, 3))):
        inside = [path for path in places(tree) if path]
        path = draw(st.sampled_from(inside))
        holder, key = get(tree, path[:-1]), path[-1]
        what = draw(st.sampled_from(["odd", "odd", "number", "number", "remove", "copy", "rename", "double"]))
        if what == "odd":
            holder[key] = copy.deepcopy(draw(ODD))
        elif what == "number":
            numbers = [p for p in inside if type(get(tree, p)) in (int, float)]
            path = draw(st.sampled_from(numbers or inside))
            get(tree, path[:-1])[path[-1]] = draw(st.floats(-1e7, 1e7) | st.integers(-400, 400))
        elif what == "remove":
            del holder[key]
        elif what == "copy":
            holder[key] = copy.deepcopy(get(tree, draw(st.sampled_from(inside))))
        elif what == "rename" and isinstance(holder, dict):
            holder[draw(st.sampled_from(["name", "kind", "frame", "to", "inputs", "far", "x", 1, None]))] = holder.pop(
                key
            )
        elif what == "double" and isinstance(holder, list):
            holder.append(copy.deepcopy(holder[key]))
        if not any(True for path in places(tree) if path):
            break
    return tree


PIECES = st.sampled_from(
    [
        " ",
        "  ",
        "\n",
        "\n  ",
        ":",
        ": ",
        "- ",
        "-",
        ",",
        "[",
        "]",
        "{",
        "}",
        "&a ",
        "*a",
        "<<: *a",
        "#",
        "'",
        '"',
        "|",
        ">",
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
)


@st.composite
def changed_texts(draw, texts):
    text = draw(st.sampled_from(texts))
    for _ in range(draw(st.integers(1, 4))):
        at = int(draw(st.floats(0, 1)) * len(text))
        out = draw(st.sampled_from([0, 0, 1, 1, 2, 5, 40]))
        what = draw(st.sampled_from(["piece", "piece", "nothing", "line", "swap"]))
        if what == "line":
            at = text.rfind("\n", 0, at) + 1
            end = text.find("\n", at) + 1 or len(text)
            text = text[:end] + text[at:end] + text[end:] if out else text[:at] + text[end:]
        elif what == "swap":
            digits = [i for i, letter in enumerate(text) if letter.isdigit()]
            at = digits[min(int(draw(st.floats(0, 1)) * len(digits)), len(digits) - 1)]
            text = text[:at] + str(draw(st.integers(0, 9))) + text[at + 1 :]
        else:
            text = text[:at] + (draw(PIECES) if what == "piece" else "") + text[at + out :]
    return text
