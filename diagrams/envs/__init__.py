"""Gymnasium environments built from task, guidance and station."""

from guiderail.models.common.errors import require_extra

require_extra("pydrake")
