"""JSON files with a schema: one way to check them and to say what is wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from p2p_lib.core.errors import BadInput
from p2p_lib.core.files import LARGEST_TEXT, read_bytes


class Strict(BaseModel):
    """Values as written: no unknown field, no conversion, no change afterwards."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


def read_json(path: Path, schema: Any, what: str) -> Any:
    """What a file holds, as ``schema`` (a type); :class:`BadInput` names the file and the first field that is wrong."""
    data = read_bytes(path, what, LARGEST_TEXT)
    try:
        return TypeAdapter(schema).validate_json(data)
    except ValidationError as error:
        first = error.errors()[0]
        got = f"unreadable JSON ({first['msg']})" if first["type"] == "json_invalid" else first_fault(error)
        raise BadInput(str(path), got, what) from None


#: What should be where a value does not fit, by pydantic's name of the fault; in braces what it says of the limit.
_WANTED = {
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "string_type": "text in quotes",
    "bool_type": "true or false",
    "list_type": "a list in brackets",
    "dict_type": "a table",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "literal_error": "{expected}",
    "greater_than_equal": "at least {ge}",
    "greater_than": "more than {gt}",
    "less_than_equal": "at most {le}",
    "less_than": "less than {lt}",
    "too_short": "a list of at least {min_length}",
    "too_long": "a list of at most {max_length}",
    "string_pattern_mismatch": "text of the form {pattern}",
    "string_too_short": "some text",
}


#: Letters that are shown of what came.
_SHOWN = 60


def first_fault(error: ValidationError) -> str:
    """Where the first value is that does not fit, and why."""
    first = error.errors()[0]
    where, why, limits = ".".join(map(str, first["loc"])) or "the file", first["type"], first.get("ctx", {})
    if why == "missing":
        return f"{where}: missing"
    if why == "extra_forbidden":
        return f"{where}: a key unknown there"
    if why == "value_error":
        return f"{where}: {limits['error']}"
    wanted = _WANTED[why].format(**limits) if why in _WANTED else first["msg"]
    got = repr(first["input"])
    return f"{where}: {got if len(got) <= _SHOWN else f'{got[:_SHOWN]}...'}, where {wanted} should be"
