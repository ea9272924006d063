"""Drake LeafSystems, one a file, each a thin shell over a law that can be called without a diagram.

Every system, and what its constructor takes, can be imported from here: `from guiderail.systems import HistoryBuffer`.
The names are in `__init__.pyi`; a module is imported when the first of its names is used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
