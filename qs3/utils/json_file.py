"""JSON files of known form, read whole and checked."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

from qs3.errors import DataError
from qs3.utils.memory import JSON_PEAK, read_whole

T = TypeVar("T")


def read_json(path: Path, form: type[T], written_by: str) -> T:
    """What the file holds, as a `form`, which pydantic can check.

    Args:
        path: of the file.
        form: a dataclass.
        written_by: the command that writes such files, for the message.

    Raises:
        DataError: it cannot be read, or is damaged; says at which key.
    """
    try:
        return TypeAdapter(form).validate_json(read_whole(path, JSON_PEAK))
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror or error})") from error
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the file"
        raise DataError(
            f"{path} is damaged, or not of `{written_by}`: {place}: {first['msg']}"
        ) from error
