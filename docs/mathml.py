"""Equations as MathML: nothing to fetch, nothing to run in the browser."""

from docutils.nodes import SkipNode
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml


def _mathml(tex: str, block: bool) -> str:
    try:
        return tex2mathml(tex, as_block=block)
    except MathError as error:
        raise ValueError(f"the equation {tex!r} can't be shown: {error}") from error


def visit_inline(translator, node):
    """An equation in a line."""
    translator.body.append(_mathml(node.astext(), block=False))
    raise SkipNode


def visit_block(translator, node):
    """An equation by itself."""
    translator.body.append(f'<div class="equation">{_mathml(node.astext(), block=True)}</div>')
    raise SkipNode
