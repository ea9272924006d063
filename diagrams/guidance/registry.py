"""Registry of the kinds of guidance: builder, requirements, and label and color in figures."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from itertools import chain
from typing import TYPE_CHECKING, Any, TypeVar

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import Registry, check_kind, did_you_mean
from guiderail.models.laws.law import Law

if TYPE_CHECKING:
    from pydrake.systems.framework import Diagram

    from guiderail.diagrams.envs.options import Options
    from guiderail.diagrams.guidance.prior import PriorKnowledge

Builder = TypeVar("Builder", bound="Callable[[PriorKnowledge], Diagram | Law] | type[Law]")

REQUIREMENTS = {
    "demonstrations": "demonstrations",
    "keep_out": "walls to keep out of",
    "template": "a shared control template",
    "approach": "a scripted approach",
}
"""Possible requirements of a kind of guidance, with their description in messages."""


@dataclass(frozen=True)
class GuidanceKind:
    """Kind of guidance.

    Attributes:
        name: Value of the option `guidance`.
        build: Function from prior knowledge to a diagram with the ports of `Guidance`, or to a `Law`; or a subclass of
            `Law`, which is called with the size of the pose and `known`.
        needs: Alternative tuples of names in `REQUIREMENTS`; the task must provide all names of one alternative.
        label: Label in figures; default: `name`.
        color: Color in figures, "#rrggbb".
        demonstrates: True if an action of zero reproduces the demonstrations or the scripted approach, so that the
            success before learning can be evaluated.
        displaces: True if each entry of an action displaces one explored output. Only then is a task's symmetry used
            for data augmentation.
        options: Model of further options of the environment, if there are any.
        ignores_actions: True if actions have no effect. Such a kind is a task's default only if the task declares it or
            no other kind is possible.
    """

    name: str
    build: Callable[[PriorKnowledge], Diagram | Law] | type[Law]
    needs: tuple[tuple[str, ...], ...] = ()
    label: str = ""
    color: str = "#17becf"
    demonstrates: bool = False
    displaces: bool = False
    options: type[Options] | None = None
    ignores_actions: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "label", self.label or self.name)


def missing_requirements(needs: tuple[tuple[str, ...], ...], provided: Collection[str]) -> tuple[str, ...]:
    """Return the missing requirements of the most complete alternative in `needs`; empty if one is complete."""
    missing = [tuple(name for name in alternative if name not in provided) for alternative in needs]
    return min(missing, key=len, default=())


GUIDANCE: Registry[GuidanceKind] = Registry("guidance", plugin="guidance", check=check_kind(GuidanceKind))


def register_guidance(name: str, **declared: Any) -> Callable[[Builder], Builder]:
    """Return a decorator that registers a subclass of `Law`, or a function of a `PriorKnowledge`.

    Args:
        name: Value of the option `guidance`.
        **declared: Attributes of the `GuidanceKind`, such as `needs`, `label`, `color`, `demonstrates` and `options`.

    Raises:
        InputError: If the name is not a word, or `needs` has a name that is not in `REQUIREMENTS`. The decorator raises
            it if another kind of guidance has this name.
    """
    GUIDANCE.check_name(name)
    needs = declared.get("needs", ())
    if not isinstance(needs, tuple) or not all(isinstance(each, tuple) for each in needs):
        raise InputError(f'needs of {name!r} is a tuple of tuples, as in (("demonstrations",),), not {brief(needs)}')
    for requirement in chain(*needs):
        if requirement not in REQUIREMENTS:
            raise InputError(f"guidance {name!r} needs {brief(requirement)}: {did_you_mean(requirement, REQUIREMENTS)}")

    def add(build: Builder) -> Builder:
        GUIDANCE.register(name, GuidanceKind(name, build, **declared))
        return build

    return add


def is_demonstrated(guidance: str | None) -> bool:
    """Return True if an action of zero reproduces the demonstration, so that its success needs no learning."""
    return guidance in GUIDANCE.names() and GUIDANCE.get(str(guidance)).demonstrates


def possible_guidance(provided: Collection[str]) -> list[str]:
    """Return the sorted names of all kinds of guidance whose requirements are `provided`."""
    return [name for name, kind in GUIDANCE.entries().items() if not missing_requirements(kind.needs, provided)]


def default_guidance(possible: Collection[str]) -> str:
    """Return the first kind of guidance in `possible` that does not ignore actions; the first one if all do.

    The package's own kinds precede those that are registered by other packages.
    """
    names = sorted(possible, key=lambda name: not GUIDANCE.is_packaged(name))
    return next((name for name in names if not GUIDANCE.get(name).ignores_actions), names[0])


def check_guidance(name: str, provided: Collection[str], task: str = "this task") -> GuidanceKind:
    """Return the kind of guidance with a name, after a check that its requirements are `provided`.

    Raises:
        InputError: If there is no such kind, or a requirement is missing; the message names it.
    """
    kind = GUIDANCE.get(name)
    if missing := missing_requirements(kind.needs, provided):
        needed = " and ".join(REQUIREMENTS.get(requirement, requirement) for requirement in missing)
        possible = possible_guidance(provided)
        remedy = f"use {', '.join(possible)}" if possible else "return a Prior with it from prior()"
        raise InputError(f"guidance '{name}' needs {needed}, which {task} doesn't have: {remedy}")
    return kind


def build_guidance(name: str, prior: PriorKnowledge, task: str = "this task") -> Diagram:
    """Build a kind of guidance from prior knowledge.

    Args:
        name: Name of the kind.
        prior: Prior knowledge; missing options have their defaults.
        task: Name of the task, for the error message.

    Raises:
        InputError: If there is no such kind, or a requirement is missing.
    """
    kind = check_guidance(name, [requirement for requirement in REQUIREMENTS if prior.has(requirement)], task)
    if kind.options is not None:
        fields = kind.options.model_fields.items()
        defaults = {option: field.get_default() for option, field in fields if not field.is_required()}
        prior = replace(prior, options=defaults | dict(prior.options))
    build: Any = kind.build
    is_law_class = isinstance(build, type) and issubclass(build, Law)
    guidance = build(prior.pose_size, known=prior) if is_law_class else build(prior)
    if isinstance(guidance, Law):
        from guiderail.diagrams.guidance.guidance import LawGuidance

        guidance = LawGuidance(prior, guidance)
    guidance.set_name("guidance")
    return guidance
