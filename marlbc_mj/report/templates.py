"""The pages' Jinja2 templates. All text is escaped, and a variable that is not given is an error."""

from functools import cache
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

_HOME = "marlbc_mj.report"
"""The package whose templates every page may extend or include."""


@cache
def _environment(package: str) -> Environment:
    loaders = [PackageLoader(name, "") for name in dict.fromkeys((package, _HOME))]
    return Environment(
        loader=ChoiceLoader(loaders), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )


def render(template: str, package: str = _HOME, **values: Any) -> str:
    """Fill a template.

    Args:
        template: name of an ``.html`` file in the folder of ``package``, or else of this package.
        package: package that contains the template.
        values: variables of the template.

    Raises:
        jinja2.UndefinedError: the template uses a variable that is not given.
    """
    return _environment(package).get_template(template).render(values)
