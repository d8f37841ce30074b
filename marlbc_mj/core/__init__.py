"""The laws of the mission (behaviors, composition, orders, disturbances) and their compilation."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, {"laws"})  # for marlbc_mj.laws
