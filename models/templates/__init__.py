"""Shared control templates: what is known about a task, as data (thesis, section 2.3)."""

from guiderail.models.templates.schema import load_skill, parse_skill
from guiderail.models.templates.template import Command, Skill, SkillState, Transition

__all__ = ["Command", "Skill", "SkillState", "Transition", "load_skill", "parse_skill"]
