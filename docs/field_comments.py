"""Where the reference finds what a field is: the comment behind it in the source, which also has its unit."""

import io
import re
import tokenize
from typing import Any

from griffe import Attribute, Class, Docstring, Extension, Object

NOT_TEXT = re.compile(r"(type: ignore|noqa)")
ROLE = re.compile(r":(?:class|func|meth|data|mod):`~?(?:[\w.]+\.)?(\w+)`")


def comment_behind(lines: list[str]) -> str:
    """The comment at the end of a definition's last line; empty where there is none."""
    try:
        found = [token.string for token in tokenize.generate_tokens(io.StringIO("\n".join(lines)).readline)
                 if token.type == tokenize.COMMENT]  # fmt: skip
    except (tokenize.TokenError, IndentationError):
        return ""
    text = found[-1].lstrip("# ").strip() if found else ""
    return "" if NOT_TEXT.match(text) else text


class FieldComments(Extension):
    """Comments become the docstrings of fields without one; Sphinx roles in docstrings become plain code.

    A class lists its fields in one table of its own text, where they would else be a heading each.
    """

    def on_attribute_instance(self, *, attr: Attribute, **_: Any) -> None:
        """A field: its comment, unless it has a docstring."""
        if attr.docstring is None and attr.lineno is not None and attr.endlineno is not None:
            text = comment_behind([line.strip() for line in attr.lines])
            if text:
                attr.docstring = Docstring(text, parent=attr)

    def on_instance(self, *, obj: Object, **_: Any) -> None:
        """Whatever has a docstring."""
        if obj.docstring is not None:
            obj.docstring.value = ROLE.sub(r"`\1`", obj.docstring.value)

    def on_class_members(self, *, cls: Class, **_: Any) -> None:
        """A class, once all of its fields are known."""
        own = [each for each in cls.attributes.values() if not each.is_alias and not each.name.startswith("_")]
        fields = [each for each in own if "property" not in each.labels and (each.docstring or "class-attribute" in each.labels)]
        if not fields:
            return
        lines = [f"    {each.name}: {_one_line(each)}" for each in fields]
        before = "" if cls.docstring is None else cls.docstring.value.rstrip()
        cls.docstring = Docstring("\n".join([before, "", "Attributes:", *lines]), parent=cls)
        for each in fields:
            each.docstring = None  # and so no entry of its own


def _one_line(field: Attribute) -> str:
    """What is known of a field: its text, and its default where that is short."""
    text = "" if field.docstring is None else " ".join(field.docstring.value.split())
    default = "" if field.value is None or "class-attribute" not in field.labels else str(field.value)
    shown = f"`{default}` by default" if default and len(default) <= 24 and not default.startswith("field(") else ""
    return "; ".join(part for part in (text, shown) if part) or "\N{EN DASH}"
