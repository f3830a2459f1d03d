"""What the clouds of training were like, and whether another cloud is like them.

Five measures of a cloud, which its position, its size and a rotation about the up axis leave as
they are (and its size and height, for nets that see these), and for each the range in which the
training clouds of source and target lie. A cloud inside all ranges can still show an object of no
known class, and get a confident answer.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree

from qs3.datamodules.clouds import Clouds
from qs3.store.store import HEIGHTS

MEASURES = {
    "points": "different points",
    "spacing": "median distance to the nearest point, in radii of the cloud",
    "middle": "median distance from the centroid, in radii of the cloud (strays make it small)",
    "thickness": "smallest over largest standard deviation along the principal axes",
    "height": "standard deviation along z over that along x and y",
}
"""Names of the measures and what they are."""

OF_METRES = {"size": "largest distance of a point from the centroid, in metres"}
"""Measured of clouds that keep their size: a net would also classify millimetres."""

OF_HEIGHTS = {"base": "height of its lowest point above the floor, in metres"}
"""Measured of clouds that keep their height, too: a floor in the wrong place shows here."""

_TAIL = 0.001  # of the clouds of a domain, on either side
OTHER_UNITS = "as of other units than metres"
_NO_METRES = 10.0  # times the largest size: centimetres, millimetres or inches
_MOST = 1000  # clouds that are measured of a domain; 3 ms each
_LOOKED_AT = 300  # of a domain, for a share


def measure_one(clouds: Clouds, index: int) -> dict[str, float]:
    """The `MEASURES` of a cloud in its sample number 0, and those that its scale adds."""
    row = clouds.rows[index]
    stored = np.asarray(clouds.stored[row])
    sample = replace(clouds, scale="unit_ball").take(torch.tensor([index]))[0].numpy()
    found = measure(stored, sample)
    if clouds.scale != "unit_ball":
        found["size"] = float(clouds.radius[row])
    if clouds.scale in HEIGHTS:
        found["base"] = float(stored[:, 2].min() - clouds.floor)
    return found


def measure(stored: Float[np.ndarray, "p 3"], sample: Float[np.ndarray, "m 3"]) -> dict[str, float]:
    """The `MEASURES` of a cloud.

    Args:
        stored: the cloud before it was sampled; only its different points are counted.
        sample: of it, in the unit ball, z up.
    """
    different = np.unique(np.asarray(sample, dtype=np.float64), axis=0)
    spacing = 0.0
    if len(different) > 1:
        spacing = float(np.median(cKDTree(different).query(different, 2)[0][:, 1]))
    moved = sample - sample.mean(axis=0)
    spread = np.cov(moved.T, bias=True).astype(np.float64)
    along = np.sqrt(np.linalg.eigvalsh(spread).clip(min=0))  # ascending
    level = np.sqrt((spread[0, 0] + spread[1, 1]) / 2)
    rows = np.ascontiguousarray(stored, dtype=np.float32) + np.float32(0)  # -0 is 0
    return {
        "points": float(len(set(rows.view("V12").ravel().tolist()))),
        "spacing": spacing,
        "middle": float(np.median(np.linalg.norm(sample, axis=1))),
        "thickness": float(along[0] / along[2]) if along[2] > 0 else 0.0,
        "height": float(min(np.sqrt(spread[2, 2]) / max(level, 1e-9), 1e3)),
    }


def limits(*domains: Clouds, most: int = _MOST) -> dict[str, list[float]]:
    """The least and the largest usual value of each measure: [low, high].

    From 0.1 % to 99.9 % of the clouds of each domain, and of these ranges the lowest and highest
    end. At most `most` of a domain are measured, evenly spaced. Having many points is not a fault:
    `points` has no upper end (infinity). Its lower end is that of the clouds on disk, see
    `relax_min_points`.
    """
    ranges = []
    for clouds in domains:
        found = _measured(clouds, most)
        table = np.array([list(each.values()) for each in found])  # [clouds, measures]
        ranges.append(np.quantile(table, [_TAIL, 1 - _TAIL], axis=0))
    low = np.min([each[0] for each in ranges], axis=0)
    high = np.max([each[1] for each in ranges], axis=0)
    low[0], high[0] = np.floor(low[0]), np.inf  # points
    return {name: [float(low[i]), float(high[i])] for i, name in enumerate(found[0])}


def source_limits(source: Clouds, most: int = _MOST) -> dict[str, list[float]]:
    """`limits` of one domain, of points no more than the net sees."""
    seen = source.stored.shape[1] if source.order is None else source.order.shape[2]
    return relax_min_points(limits(source, most=most), seen)


def relax_min_points(usual: Mapping[str, list[float]], seen: int) -> dict[str, list[float]]:
    """The same ranges; a cloud with the `seen` points that a net takes does not lack any."""
    changed = {name: list(ends) for name, ends in usual.items()}
    if "points" in changed:
        changed["points"][0] = min(changed["points"][0], float(seen))
    return changed


def ood_reasons(measured: Mapping[str, float], usual: Mapping[str, list[float]]) -> list[str]:
    """Which measures lie outside the usual ranges, as text; [] if none does."""
    reasons = []
    for name, (low, high) in usual.items():
        value = measured[name]
        if low <= value <= high:
            continue
        limit = f"under {low:.4g}" if value < low else f"over {high:.4g}"
        unit = f", {OTHER_UNITS}" * (name in OF_METRES and value > _NO_METRES * high)
        reasons.append(f"{name} {value:.4g} is {limit}{unit}")
    return reasons


def other_units(reasons: Iterable[str]) -> str:
    """A warning if some of these reasons say that the clouds are not in metres; else ""."""
    count = sum(OTHER_UNITS in each for each in reasons)
    return f"{count} are too large for metres: their answers mean nothing" if count else ""


def ood_reasons_of_all(clouds: Clouds, usual: Mapping[str, list[float]]) -> list[list[str]]:
    """`ood_reasons` of each cloud."""
    return [ood_reasons(each, usual) for each in _measured(clouds, len(clouds))]


def ood_share(clouds: Clouds, source: Clouds) -> float:
    """The share of clouds outside the usual range of the source's, by at most 300 of each."""
    usual, found = source_limits(source, _LOOKED_AT), _measured(clouds, _LOOKED_AT)
    return sum(bool(ood_reasons(each, usual)) for each in found) / len(found)


def _measured(clouds: Clouds, most: int) -> list[dict[str, float]]:
    """The measures of at most `most` clouds, evenly spaced; each cloud is measured once."""
    chosen = np.unique(np.linspace(0, len(clouds) - 1, min(len(clouds), most)).astype(int))
    known = vars(clouds).setdefault("_measured", {})  # with them, as a cached property is
    known |= {i: measure_one(clouds, i) for i in chosen.tolist() if i not in known}
    return [known[i] for i in chosen.tolist()]
