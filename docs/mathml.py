"""Equations as MathML, which browsers show without scripts."""

from xml.etree import ElementTree

from docutils.nodes import SkipNode
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml

NAMESPACE = "http://www.w3.org/1998/Math/MathML"
ACCENTS = ("ˆ", "ˉ", "˜")


def mathml(tex: str, block: bool) -> str:
    """Convert an equation; the index of an accented letter is a subscript, not below the letter."""
    try:
        text = tex2mathml(tex, as_block=block)
    except MathError as error:
        raise ValueError(f"the equation {tex!r} cannot be converted: {error}") from error
    ElementTree.register_namespace("", NAMESPACE)
    root = ElementTree.fromstring(text.replace("&ApplyFunction;", "\N{FUNCTION APPLICATION}"))  # not an entity of XML
    for over in root.iter(f"{{{NAMESPACE}}}munderover"):
        base, index, accent = over
        if (accent.text or "") in ACCENTS:
            over.tag = f"{{{NAMESPACE}}}msub"
            over[:] = [ElementTree.Element(f"{{{NAMESPACE}}}mover"), index]
            over[0].extend([base, accent])
    for over in root.iter(f"{{{NAMESPACE}}}mover"):
        over.attrib.pop("accent", None)  # browsers draw it into capital letters
    return ElementTree.tostring(root, encoding="unicode")


def visit_inline(translator, node):
    """Write an inline equation."""
    translator.body.append(mathml(node.astext(), block=False))
    raise SkipNode


def visit_block(translator, node):
    """Write a displayed equation."""
    translator.body.append(f'<div class="equation">{mathml(node.astext(), block=True)}</div>')
    raise SkipNode
