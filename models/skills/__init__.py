"""Shared control templates: what is known about a task, as data (thesis, section 2.3)."""

from guiderail.models.skills.loader import load_skill, parse_skill
from guiderail.models.skills.skill import Command, Skill, SkillState, Transition

__all__ = ["Command", "Skill", "SkillState", "Transition", "load_skill", "parse_skill"]
