"""Drake LeafSystems; most of them wrap a law of `models` that can also be called without a diagram.

The systems and the public classes of their files are exported: `from guiderail.systems import HistoryBuffer`.
`__init__.pyi` lists the names. A module is imported at the first use of one of its names.
"""

import lazy_loader

from guiderail.models.common.errors import require_extra

require_extra("pydrake")

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
