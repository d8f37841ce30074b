"""The pages' Jinja2 templates: plain data in, HTML out. All text is escaped; a name that is not given is an error."""

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
        template: name of an ``.html`` file in the folder of ``package``, or else of this one.
        package: where the template is.
        values: variables of the template.

    Raises:
        jinja2.UndefinedError: the template names a value that is not given.
    """
    return _environment(package).get_template(template).render(values)
