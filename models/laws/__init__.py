"""Laws of guidance on arrays, which run in Drake diagrams, in `GuidedEnv`, on a robot and in exported skills.

`__init__.pyi` lists the public names. A module is imported at the first use of one of its names.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
