"""The kinds of guidance by name: how each is made, what it needs, and how it is drawn."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import Registry

if TYPE_CHECKING:
    from pydrake.systems.framework import Diagram

    from guiderail.diagrams.envs.options import Options
    from guiderail.diagrams.guidance.prior import PriorKnowledge

REQUIREMENTS = {
    "demonstrations": "demonstrations",
    "keep_out": "walls to keep out of",
    "template": "a shared control template",
    "approach": "a scripted approach",
}
"""What a kind of guidance can need, in words."""


@dataclass(frozen=True)
class GuidanceKind:
    """A kind of guidance.

    Attributes:
        name: what `guidance=` calls it.
        build: from what is known to a diagram with the ports of `Guidance`.
        needs: alternatives, each a tuple of names out of `REQUIREMENTS`; the task must declare all names of one of them.
        label: what a legend calls it.
        colour: what it is drawn with, "#rrggbb".
        demonstrates: whether an action of zero is the demonstrations or the script alone, so that success before
            anything is learned can be stated.
        displaces: whether an action displaces the explored outputs, a number for each. Only of such actions a task's
            symmetry says what they are from another side; learning by any other goes on without it.
        options: a model of further options of the environment; none unless given.
    """

    name: str
    build: Callable[[PriorKnowledge], Diagram]
    needs: tuple[tuple[str, ...], ...]
    label: str
    colour: str
    demonstrates: bool = False
    displaces: bool = False
    options: type[Options] | None = None

    def missing_requirements(self, known: Collection[str]) -> tuple[str, ...]:
        """The names in `needs` that `known` lacks, of the alternative that lacks fewest; empty if one is complete."""
        lacking = [tuple(one for one in needed if one not in known) for needed in self.needs]
        return min(lacking, key=len, default=())


GUIDANCE: Registry[GuidanceKind] = Registry(
    "guidance",
    package="guiderail.diagrams.guidance",
    decorator="register_guidance",
    entry_points="guiderail.guidance",
)


def register_guidance(
    name: str,
    *,
    needs: tuple[tuple[str, ...], ...] = (),
    label: str | None = None,
    colour: str = "#17becf",
    demonstrates: bool = False,
    displaces: bool = False,
    options: type[Options] | None = None,
) -> Callable[[Callable[[PriorKnowledge], Diagram]], Callable[[PriorKnowledge], Diagram]]:
    """A decorator that adds a kind of guidance; it decorates a function or a class that takes a `PriorKnowledge`.

    Args:
        name: what `guidance=` calls it.
        needs, colour, demonstrates, displaces, options: see `GuidanceKind`.
        label: what a legend calls it; its name unless given.
    """

    def add(build: Callable[[PriorKnowledge], Diagram]) -> Callable[[PriorKnowledge], Diagram]:
        kind = GuidanceKind(name, build, needs, label or name, colour, demonstrates, displaces, options)
        GUIDANCE.register(name, kind)
        return build

    return add


def possible_guidance(known: Collection[str]) -> list[str]:
    """The names of all kinds of guidance whose `needs` are among `known`."""
    return [name for name in GUIDANCE.names() if not GUIDANCE.get(name).missing_requirements(known)]


def check_guidance(name: str, known: Collection[str], task: str = "this task") -> GuidanceKind:
    """The kind of that name, if its `needs` are among what is known of a task.

    Raises:
        InputError: if there is no such kind, or something that it needs is missing: then it says what.
    """
    kind = GUIDANCE.get(name)
    lacking = kind.missing_requirements(known)
    if lacking:
        words = " and ".join(REQUIREMENTS.get(one, one) for one in lacking)
        raise InputError(
            f"guidance '{name}' needs {words}, which {task} doesn't have: use {', '.join(possible_guidance(known))}"
        )
    return kind


def build_guidance(name: str, known: PriorKnowledge, task: str = "this task") -> Diagram:
    """The guidance of that name, made of what is known.

    Args:
        name: of the kind.
        known: what it is made of.
        task: of what, for a sentence.

    Raises:
        InputError: if there is no such kind, or something that it needs is missing.
    """
    kind = check_guidance(name, [one for one in REQUIREMENTS if known.has(one)], task)
    guidance = kind.build(known)
    guidance.set_name("guidance")
    return guidance
