from .law import Command as Command
from .law import Law as Law
from .law import Stepper as Stepper
from .primitive import PrimitiveLaw as PrimitiveLaw
from .primitive import StateProgress as StateProgress
from .primitive import load_law as load_law
from .template_law import TemplateLaw as TemplateLaw
