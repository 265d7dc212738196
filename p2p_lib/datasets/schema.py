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


def first_fault(error: ValidationError) -> str:
    """Where the first value is that does not fit, and why."""
    first = error.errors()[0]
    return f"{'.'.join(map(str, first['loc'])) or 'the file'}: {first['msg']}"
