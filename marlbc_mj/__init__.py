"""marlbc_mj: a MuJoCo benchmark for teams of robots that must decide and control at once.

The public names are those of ``__init__.pyi``. Each loads when it is first used, so that the command line can choose a renderer
before MuJoCo is imported.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
