"""The laws of the mission (behaviors, composition, orders, disturbances) and how a law is compiled."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, {"laws"})  # marlbc_mj.laws is looked up here
