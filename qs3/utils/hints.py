"""What was meant: the nearest word, and what to type after an error of Hydra or OmegaConf."""

from __future__ import annotations

import difflib
import shlex
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

_BEGINS = 3  # letters that tell which word they begin


def nearest(word: str, known: Iterable[str]) -> str:
    """The choice that is meant: the first that the word begins, else the one most like it."""
    known = list(known)
    if len(word) >= _BEGINS and (longer := [one for one in known if one.startswith(word)]):
        return longer[0]
    return next(iter(difflib.get_close_matches(word, known, n=1)), "")


def missing_of(error: Exception, words: Sequence[str]) -> str:
    """What OmegaConf found missing, in two lines at most; "" of other errors.

    Args:
        error: of an interpolation, such as ${seed}.
        words: of the command line.
    """
    if not type(error).__module__.startswith("omegaconf."):
        return ""
    first, *others = str(error).splitlines() or [type(error).__name__]
    first = first.rpartition(" raised while resolving interpolation: ")[2]
    keys = [line.partition("full_key: ")[2] for line in others if "full_key: " in line]
    place = f"{keys[-1]}: " if keys else ""  # the last one is whose value was asked for
    gone = [word for word in words if word.startswith("~")]
    hint = f"\nleave out {' or '.join(gone)}, which deletes it" if gone else ""
    return f"ConfigError: {place}{first}{hint}"


def hint_of(error: BaseException | None, words: Sequence[str]) -> str:
    """What to type instead of one of `words`, of Hydra's error of a choice or key there is not.

    It goes below Hydra's own message, or behind it; "" of other errors.
    """
    unread = getattr(error, "override", None)  # of OverrideParseException
    if isinstance(unread, str) and "=" in unread:
        asks, _, value = unread.partition("=")
        inner = value.replace('"', '\\"')
        typed = shlex.quote(f'{asks}="{inner}"')
        return f"if that is text, such as a path, quote it twice: {typed}"
    asked, there = getattr(error, "missing_cfg_file", None), getattr(error, "options", None)
    if asked and there:  # MissingConfigException
        group, _, name = asked.rpartition("/")
        keys = [word.removesuffix(f"={name}") for word in words if word.endswith(f"={name}")]
        key = keys[0] if keys else group  # as it was typed: domain@data.target
        return f"did you mean {key}={near}?" if (near := nearest(name, there)) else ""
    cause = error and error.__cause__  # of ConfigCompositionException, by OmegaConf
    key, node = getattr(cause, "key", None), getattr(cause, "parent_node", None)
    if not isinstance(key, str) or not isinstance(node, Mapping):
        return ""
    place = str(getattr(cause, "full_key", key)).removesuffix(key)
    if near := nearest(key, keys := [str(known) for known in node]):
        return f"did you mean {place}{near}=?"
    if below := [known for known in keys if _has(node, known, key)]:
        return f"did you mean {place}{below[0]}.{key}=?"
    keys = [known for known in keys if not known.startswith("_")]
    return f"keys of {place.rstrip('.') or 'the config'} are {', '.join(keys)}" if keys else ""


def _has(node: Mapping[str, Any], name: str, key: str) -> bool:
    """Whether a part of a config has a key; values that cannot be resolved yet have none."""
    try:
        part = node[name]
    except Exception:  # of any resolver: a hint never takes the place of the error it belongs to
        return False
    return isinstance(part, Mapping) and key in part
