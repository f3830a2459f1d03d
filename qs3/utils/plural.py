"""A number with its noun, for messages."""


def counted(count: float, one: str, many: str = "") -> str:
    """Such as "1 cloud" and "2 clouds".

    Args:
        count: >= 0.
        one: what follows a 1, a verb with it if need be: "cloud has".
        many: what follows any other number; `one` with an s if not given.
    """
    return f"{count} {one if count == 1 else many or f'{one}s'}"
