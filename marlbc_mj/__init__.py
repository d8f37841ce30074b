"""marlbc_mj: a MuJoCo benchmark for teams of robots that must decide and control at the same time.

``__init__.pyi`` lists the public names. Each is loaded on first use, so that the command line can choose a renderer before MuJoCo
is imported.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
