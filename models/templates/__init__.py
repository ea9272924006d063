"""Shared control templates (SCT): prior knowledge of a task as data (thesis, section 2.3)."""

from guiderail.models.templates.schema import load_template, parse_template
from guiderail.models.templates.template import Command, SharedControlTemplate, TemplateState, Transition

__all__ = ["Command", "SharedControlTemplate", "TemplateState", "Transition", "load_template", "parse_template"]
