"""YAML that nobody vouches for: looked through before it is read.

In a few lines with anchors and aliases a text can stand for more values than there is memory.
"""

from __future__ import annotations

from typing import Any

from qs3.errors import DataError

MOST_VALUES = 100_000
MOST_DEPTH = 64


def load_yaml(text: str, where: object) -> Any:
    """The plain values of a text that `check_yaml` lets through.

    Raises:
        DataError: begins with `where`.
    """
    import yaml  # type: ignore[import-untyped,unused-ignore]

    check_yaml(text, where)
    try:
        return yaml.safe_load(text)
    except Exception as error:  # a day that no month has, a number that none is: of Python's kinds
        raise DataError(f"{where} is not readable: {str(error).splitlines()[0]}") from error


def check_yaml(text: str, where: object) -> None:
    """Refuse a text with too many values once its aliases are followed, or nested too deeply.

    Raises:
        DataError: begins with `where`; also if the text is not YAML.
    """
    import yaml  # type: ignore[import-untyped,unused-ignore]

    sizes: dict[str, int] = {}  # values below each anchor, of those that are complete
    begun: list[tuple[str | None, int]] = []
    count = 0
    try:
        for event in yaml.parse(text, yaml.SafeLoader):
            if isinstance(event, yaml.CollectionEndEvent):
                anchor, before = begun.pop()
                if anchor:
                    sizes[anchor] = count - before
                continue
            if not isinstance(event, yaml.NodeEvent):
                continue
            if isinstance(event, yaml.AliasEvent):
                if event.anchor not in sizes:
                    raise DataError(f"{where}: *{event.anchor} stands for itself, or for nothing")
                count += sizes[event.anchor]
            elif isinstance(event, yaml.CollectionStartEvent):
                begun.append((event.anchor, count))
                count += 1
            else:
                count += 1
                sizes[event.anchor] = 1
            if count > MOST_VALUES or len(begun) > MOST_DEPTH:
                raise DataError(
                    f"{where}: more than {MOST_VALUES} values, or lists within lists deeper than "
                    f"{MOST_DEPTH}; refused"
                )
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise DataError(f"{where} is not readable: {str(error).splitlines()[0]}") from error
