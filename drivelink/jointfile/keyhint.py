"""Suggests the key that was probably meant by an unknown one."""

from __future__ import annotations

import dataclasses
import difflib
import typing
from typing import Any

from pydantic import BaseModel


def unknown_key(root: type, location: tuple[int | str, ...]) -> str:
    """Return the message for an unknown key, from the keys of its table."""
    section: Any = root
    for part in location[:-1]:
        if isinstance(part, str):
            section = _table(_keys(section).get(part))
    known = list(_keys(section))
    close = difflib.get_close_matches(str(location[-1]), known, n=1)
    if close:
        return f"unknown key, did you mean {close[0]}?"
    return f"unknown key, expected one of {', '.join(known)}" if known else "unknown key"


def _keys(section: Any) -> dict[str, Any]:
    """Name and annotation of each key of a table's schema."""
    if isinstance(section, type) and issubclass(section, BaseModel):
        return {name: info.annotation for name, info in section.model_fields.items()}
    if dataclasses.is_dataclass(section) and isinstance(section, type):
        hints = typing.get_type_hints(section)
        return {field.name: hints[field.name] for field in dataclasses.fields(section)}
    return {}


def _table(annotation: Any) -> Any:
    """The table's schema in an annotation like `tuple[MotorSection, ...]` or `Section | None`."""
    if _keys(annotation):
        return annotation
    found = (_table(argument) for argument in typing.get_args(annotation))
    return next((table for table in found if table is not None), None)
