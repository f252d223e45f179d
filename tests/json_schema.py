"""A validator of JSON schemas for tests, of the few keywords that our schemas use."""

from __future__ import annotations

import re
from typing import Any


def matches(value: Any, schema: dict[str, Any], root: dict[str, Any] | None = None) -> bool:
    """Return whether a value matches a JSON schema.

    The schema must use no other keywords than this function knows; `root` is the whole schema, which has definitions.
    """
    whole = root or schema
    known = {
        "$ref": lambda to: matches(value, whole["$defs"][to.removeprefix("#/$defs/")], whole),
        "allOf": lambda parts: all(matches(value, part, whole) for part in parts),
        "oneOf": lambda parts: sum(matches(value, part, whole) for part in parts) == 1,
        "const": lambda other: value == other,
        "type": lambda name: {
            "object": isinstance(value, dict),
            "array": isinstance(value, list),
            "string": isinstance(value, str),
            "boolean": isinstance(value, bool),
            "integer": type(value) is int or (type(value) is float and value.is_integer()),
            "number": type(value) in (int, float),
        }[name],
        "required": lambda names: all(name in value for name in names),
        "properties": lambda inner: all(
            matches(value[name], part, whole) for name, part in inner.items() if name in value
        ),
        "items": lambda part: all(matches(item, part, whole) for item in value),
        "minItems": lambda least: len(value) >= least,
        "maxItems": lambda most: len(value) <= most,
        "minLength": lambda least: len(value) >= least,
        "maxLength": lambda most: len(value) <= most,
        "minimum": lambda least: value >= least,
        "maximum": lambda most: value <= most,
        "exclusiveMinimum": lambda bound: value > bound,
        "pattern": lambda pattern: re.search(pattern, value) is not None,
    }
    order = ["type", *(set(schema) - {"type", "$schema", "$defs", "title"})]
    return all(known[keyword](schema[keyword]) for keyword in order if keyword in schema)
