"""Equations as MathML: nothing to fetch, nothing to run in the browser."""

from xml.etree import ElementTree

from docutils.nodes import SkipNode
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml

NAMESPACE = "http://www.w3.org/1998/Math/MathML"
ACCENTS = ("ˆ", "ˉ", "˜")


def mathml(tex: str, block: bool) -> str:
    """An equation; where a letter has an accent and an index, the index is beside it and not below."""
    try:
        text = tex2mathml(tex, as_block=block)
    except MathError as error:
        raise ValueError(f"the equation {tex!r} can't be shown: {error}") from error
    ElementTree.register_namespace("", NAMESPACE)
    root = ElementTree.fromstring(text)
    for over in root.iter(f"{{{NAMESPACE}}}munderover"):
        base, index, accent = over
        if (accent.text or "") in ACCENTS:
            over.tag = f"{{{NAMESPACE}}}msub"
            over[:] = [ElementTree.Element(f"{{{NAMESPACE}}}mover"), index]
            over[0].extend([base, accent])
    for over in root.iter(f"{{{NAMESPACE}}}mover"):
        over.attrib.pop("accent", None)  # a browser would draw it into a capital letter
    return ElementTree.tostring(root, encoding="unicode")


def visit_inline(translator, node):
    """An equation in a line."""
    translator.body.append(mathml(node.astext(), block=False))
    raise SkipNode


def visit_block(translator, node):
    """An equation by itself."""
    translator.body.append(f'<div class="equation">{mathml(node.astext(), block=True)}</div>')
    raise SkipNode
