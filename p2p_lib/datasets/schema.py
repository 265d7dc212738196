"""JSON files with a schema: one way to check them and to say what is wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from p2p_lib.core.errors import BadInput, MissingData


class Strict(BaseModel):
    """Values as written: no unknown field, no conversion, no change afterwards."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


def read_json(path: Path, schema: Any, what: str) -> Any:
    """What a file holds, as ``schema`` (a type); :class:`BadInput` names the file and the first field that is wrong."""
    try:
        return TypeAdapter(schema).validate_json(path.read_bytes())
    except FileNotFoundError:
        raise MissingData(str(path), f"no such file, expected {what}") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the file"
        raise BadInput(str(path), f"{where}: {first['msg']}", what) from None
