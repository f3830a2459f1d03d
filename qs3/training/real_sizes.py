"""Whether clouds that a net sees in metres are in metres, and above their floor.

That a domain is says its config (`unit`, `floor_m`), which for own clouds is somebody's word. Files
in millimetres would train without an error, on a target of which the net then says one class.
"""

from __future__ import annotations

import logging

import numpy as np
from jaxtyping import Bool

from qs3.datamodules.clouds import Clouds
from qs3.datamodules.splits import Unlabelled
from qs3.errors import DataError
from qs3.utils.plural import counted
from qs3.utils.text_table import printable

log = logging.getLogger(__name__)

_TIMES = 10.0  # larger: centimetres, millimetres, inches, or strays metres away from the object
_BELOW_M = 0.3  # under all of the other domain; floors are known to a decimetre or two
_LOOKED_AT = 1000  # clouds, for the floor: those are read from disk
_SHOWN = 3  # names, in the log


def check_real_sizes(target: str, source: Clouds, *parts: Unlabelled) -> None:
    """Compare a target's clouds with the labelled ones, if the net sees sizes.

    Some that are more than ten times as large as any labelled one are named in a warning; so is a
    floor that half of the clouds reach through.

    Args:
        target: the domain's name, for messages.
        source: the labelled clouds.
        parts: the target's, such as those for training and for test.

    Raises:
        DataError: more than half of a part are so large, or more than half of the source's clouds
            are so large beside all of the target's.
    """
    if source.scale == "unit_ball":
        return
    for part in parts:
        _check_sizes(target, source, part)
        if source.scale == "above_floor":
            _check_floor(target, source, part.clouds)


def _check_sizes(target: str, source: Clouds, part: Unlabelled) -> None:
    of_source, of_part = _radii(source), _radii(part.clouds)
    if _most(small := of_source > _TIMES * of_part.max()):
        raise DataError(
            f"the labelled clouds are more than ten times as large as any of {target} "
            f"({int(small.sum())} of {len(small)}; their median radius is "
            f"{np.median(of_source):.3g}, there {np.median(of_part):.3g}): one of the two is not "
            f"in metres; {_DO}"
        )
    large = of_part > _TIMES * of_source.max()
    if not large.any():
        return
    what = (
        f"{target}: {counted(int(large.sum()), 'cloud')} of {len(large)} more than ten times as "
        f"large as any labelled one (radii up to {of_part.max():.4g}, there {of_source.max():.3g})"
    )
    if _most(large):
        raise DataError(f"{what}: they are not in metres, as `unit` says; {_DO}")
    shown = [part.ids[i] for i in np.flatnonzero(large)[:_SHOWN]]
    names = ", ".join(shown) + ", ..." * (int(large.sum()) > _SHOWN)
    log.warning(
        "%s: %s; not in metres as the others, or with points far from the object: correct them or "
        "leave them out, the net's answers for them mean nothing",
        what,
        printable(names),
    )


_DO = (
    "divide millimetres by 1000, centimetres by 100 and inches by 39.37 in the files, or set "
    "data.scale=unit_ball, for which sizes do not matter"
)


def _check_floor(target: str, source: Clouds, clouds: Clouds) -> None:
    lowest, usual = _lowest(clouds), _lowest(source)
    if _most(lowest < usual.min() - _BELOW_M):
        log.warning(
            "%s: half of the clouds end %.2g m or more below their floor (floor_m=%g): is it "
            "there? If their origin is the camera, it is minus its height: "
            "data.target.floor_m=-1.25",
            target,
            -np.median(lowest),
            clouds.floor,
        )


def _most(those: Bool[np.ndarray, " n"]) -> bool:
    return 2 * int(those.sum()) > len(those)


def _radii(clouds: Clouds) -> np.ndarray:
    return np.asarray(clouds.radius[clouds.rows])


def _lowest(clouds: Clouds) -> np.ndarray:
    """Height above the floor of the lowest point of each cloud, or of some, evenly spaced."""
    some = np.unique(np.linspace(0, len(clouds) - 1, min(len(clouds), _LOOKED_AT)).astype(int))
    return clouds.at(some).all()[:, :, 2].min(dim=1).values.numpy()
