"""The measured facts as text for people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from qs3.report.inspection import columns
from qs3.report.inspection.gap import PLATE_M
from qs3.utils import text_table
from qs3.utils.plural import counted
from qs3.utils.text_table import three_digits

Numbers = dict[str, Any]


def of_domain(facts: Numbers) -> str:
    """Text about one domain (`measure.inspect`)."""
    counts, extents, spacing = facts["counts"], facts["extents"], facts["spacing"]
    parts = [
        f"{facts['domain']}: {facts['folder']}, {facts['variant']}",
        f"made of: {facts['made_of']}",
        f"{counted(counts['clouds'], 'cloud')} of {facts['points']} points; "
        f"content {facts['sha256'][:16]}",
    ]
    if facts["looked_at"] < counts["clouds"]:
        parts.append(
            f"sizes and spacing: of {counted(facts['looked_at'], 'cloud')} drawn with seed "
            f"{facts['seed']} (sample=N for more)"
        )
    parts += ["", "clouds", _counts(counts)]
    for split, of in counts["splits"].items():
        some = {cls: n for cls, n in of["by_class"].items() if n}
        if some:
            cls, most = max(some.items(), key=lambda one: one[1])
            parts.append(
                f"{split}: {cls} is {most / sum(some.values()):.1%}, "
                f"{most / min(some.values()):.1f} times the smallest class"
            )
    parts += columns.text(facts["columns"])
    unit = "unit ball" if extents["in_unit_ball"] else "as stored"
    parts += [
        *_valid(facts["valid_points"]),
        "",
        f"size ({unit}), spacing, density and coverage: medians",
        _sizes(extents, spacing),
        "spacing: to the nearest other point in units of the unit ball (5 %, median, 95 %), and as "
        "stored; cv: standard deviation over mean of the spacing, and of the points in a voxel of "
        "1/8; seen: share of 72 directions from the centroid with a point, of the lowest 24; "
        "lonely: share of points far from all others",
        f"centroid off the origin {three_digits(extents['centroid_offset_median'])}, floor at "
        f"{three_digits(extents['floor_median'])} (medians)",
    ]
    if odd := extents["odd_sizes"]:
        more = ", ..." * (len(odd) > 5)
        beside = " for their class" * (counts["unlabelled"] < counts["clouds"])
        parts.append(f"odd sizes{beside}: {len(odd)}: {', '.join(odd[:5])}{more}")
    parts += ["", "which way is up, by the shape", *_ups(facts["gravity"])]
    parts += ["", "copies", *_copies(facts["copies"], spacing["all"]["copies"])]
    return "\n".join(parts)


def of_pair(facts: Numbers) -> str:
    """Markdown about two domains (`measure.compare`)."""
    prior, apart = facts["prior"], facts["told_apart"]
    frequencies = [["class", "A", "B", "B - A"]]
    frequencies += [
        [cls, f"{p:.1%}", f"{q:.1%}", f"{100 * (q - p):+.1f}"]
        for cls, (p, q) in prior["by_class"].items()
    ]
    rows = [["by", "own domain"]]
    rows += [[by, f"{apart[by]:.1%}"] for by in ("all", "shape", "density")]
    parts = [
        f"# A = {facts['a']}, B = {facts['b']}",
        f"A is made of: {facts['made_of_a']}.\nB is made of: {facts['made_of_b']}.",
        "## Class frequencies",
        _markdown(frequencies),
        f"Total variation {prior['total_variation']:.3f} (0: equal, 1: disjoint).",
        "## The gap at a glance",
        _markdown(_glance(facts)),
        f"Clouds of {facts['points']} points in the unit ball, as a net sees them: by farthest "
        "point sampling where more are stored. Medians of up to 60 clouds a class, drawn with "
        f"seed {facts['seed']}.",
        *_truths(facts),
        *_floors(facts),
        "## Told apart by their nearest neighbours",
        _markdown(rows),
        "Share of clouds whose most similar cloud is of their own domain (50 %: cannot be told "
        f"apart, 100 %: two worlds). {counted(apart['clouds'], 'cloud')} of each, equally many a "
        "class.",
    ]
    return "\n\n".join(parts) + "\n"


def _table(rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(text_table.aligned(rows, numbers=True, rule=False))


def _markdown(rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(text_table.markdown(rows, numbers=True))


def _counts(counts: Numbers) -> str:
    splits = counts["splits"]
    columns = {cls: [of["by_class"][cls] for of in splits.values()] for cls in counts["classes"]}
    totals = [of["clouds"] for of in splits.values()]
    known = [sum(of["by_class"].values()) for of in splits.values()]
    columns["unlabelled"] = [n - k for n, k in zip(totals, known, strict=True)]
    columns = {name: column for name, column in columns.items() if any(column)}
    rows = [
        [name, *map(str, column), str(sum(column))]
        for name, column in {**columns, "all": totals}.items()
    ]
    return _table([["class", *splits, "all"], *rows])


def _valid(valid: Numbers) -> list[str]:
    found = []
    if valid["known"]:
        clouds = counted(valid["repeating"], "cloud has", "clouds have")
        found.append(
            f"points before sampling: {valid['median']:.0f} (median), at least {valid['min']}"
            + f"; {clouds} too few: some are repeated" * bool(valid["repeating"])
        )
    return found + [f"left out: {n} {status}" for status, n in valid["left_out"].items()]


def _sizes(extents: Numbers, spacing: Numbers) -> str:
    heads = ["x", "y", "z", "largest side", "spacing", "as stored", "cv", "cv voxel", "seen"]
    rows = [["class", *heads, "below", "lonely"]]
    for cls, size in extents["by_class"].items():
        ends = (three_digits(size[f"largest_side_{end}"]) for end in ("min", "max"))
        side = "..".join(ends)
        rows.append([cls, *_sides(size), side, *_spaced(spacing["by_class"][cls])])
    return _table([*rows, ["all", *_sides(extents), "", *_spaced(spacing["all"])]])


def _sides(size: Numbers) -> list[str]:
    return [three_digits(side) for side in size["size_median"]]


def _spaced(of: Numbers) -> list[str]:
    return [
        f"{of['nn_low']:.3f} {of['nn_median']:.3f} {of['nn_high']:.3f}",
        three_digits(of["nn_median_raw"]),
        f"{of['nn_variation']:.2f}",
        f"{of['voxel_variation']:.2f}",
        f"{of['directions']:.0%}",
        f"{of['below']:.0%}",
        f"{of['lonely']:.2%}",
    ]


def _ups(up: Numbers) -> list[str]:
    if not up["by_class"]:
        return ["unknown: no clouds with labels of the ten classes"]
    shares = ["along this axis", "this way, not the other", "rather on z"]
    rows = [["class", "up", "clouds", *shares, "evidence"]]
    for cls, of in up["by_class"].items():
        shown, evidence = "?", "weak"
        # On z and not better than on their sides: too few for `_up_verdict`, too.
        if of["axis_sure"] and (of["stands"] or of["up"][1] != "z"):
            shown, evidence = f"{of['up'][1]}?", "of the axis only"
            if of["sign_sure"]:
                shown, evidence = of["up"], "clear"
        if of["lies"] and not (of["axis_sure"] and of["up"][1] != "z"):
            shown, evidence = "lies", "on its sides, each cloud its own way"
        numbers = [of[share] for share in ("axis_share", "sign_share", "on_z_share")]
        shares = ["-" if number is None else f"{number:.0%}" for number in numbers]
        rows.append([cls, shown, str(of["clouds"]), *shares, evidence])
    lines = [_table(rows), _up_verdict(up)]
    if up["single_views"]:
        lines.append(
            "by single views: an axis that the clouds of a class have in common; not whether each "
            "lies its own way"
        )
    return lines


def _up_verdict(up: Numbers) -> str:
    weak = [cls for cls in up["by_class"] if cls not in up["contradicting"] + up["confirming"]]
    untold = f"; of {', '.join(weak)} the shapes do not tell" if weak else ""
    if up["contradicting"]:
        return (
            f"WARNING: {', '.join(up['contradicting'])} do not stand upright on z{untold}. A wrong "
            "axis costs tens of points of accuracy: check the importer's `up`, or for clouds from "
            "generate.py the `up` of the meshes" + f". {_OF_FUSED}" * (up["single_views"] is None)
        )
    if up["confirming"]:
        return f"z is up, by the shapes of {', '.join(up['confirming'])}{untold}"
    return "unknown: the shapes of no class tell which way is up; look at clouds.png"


_OF_FUSED = (
    "Nothing tells from how many views these clouds are: of single views, which lack whole sides, "
    "this can be a false alarm; look at clouds.png"
)


def _copies(copies: Numbers, points: float) -> list[str]:
    lines = [f"points that repeat another one of their cloud: {points:.2%}"]
    lines.append(f"clouds that repeat another one: {copies['clouds']}")
    lines += [f"  {' = '.join(group)}" for group in copies["groups"][:5]]
    if copies["leaks"]:
        leaks = counted(copies["leaks"], "cloud")
        lines.append(f"WARNING: in the test split and in another one, too: {leaks}")
    if copies["contradicting_labels"]:
        torn = counted(copies["contradicting_labels"], "of them has", "of them have")
        lines.append(f"WARNING: {torn} several labels")
    if copies["leaking_meshes"]:
        meshes = counted(copies["leaking_meshes"], "mesh is", "meshes are")
        lines.append(f"WARNING: {meshes} in test and in another split")
    elif copies["meshes"]:
        meshes = counted(copies["meshes"], "mesh", "different meshes")
        lines.append(f"{meshes}, none in test and another split")
    return lines


_GLANCE = (
    ("cloud", "nearest-neighbour spacing", "nn_median", "{:.4f}"),
    ("cloud", "its coefficient of variation", "nn_variation", "{:.2f}"),
    ("cloud", "variation of points a voxel (1/8)", "voxel_variation", "{:.2f}"),
    ("cloud", "directions seen", "directions", "{:.0%}"),
    ("cloud", "of the lowest third", "below", "{:.0%}"),
    ("cloud", "repeated points", "copies", "{:.2%}"),
    ("cloud", "lonely points", "lonely", "{:.2%}"),
    ("surface", "off the true surface, median", "median_ball", "{:.4f}"),
    ("surface", "off the true surface, 95 %", "p95_ball", "{:.4f}"),
    ("surface", "off the true surface, median, as stored", "median", "{:.4f}"),
    ("surface", "off the true surface, 95 %, as stored", "p95", "{:.4f}"),
    ("surface", "true surface measured", "measured", "{:.0%}"),
)


def _glance(facts: Numbers) -> list[list[str]]:
    rows = [["", "A", "B"]]
    for of, words, key, form in _GLANCE:
        values = [facts[f"{of}_{side}"].get(key) for side in "ab"]
        if any(value is not None for value in values):
            rows.append([words, *("-" if v is None else form.format(v) for v in values)])
    return rows


def _truths(facts: Numbers) -> list[str]:
    lines, sides = [], {side: facts[f"surface_{side}"] for side in "ab"}
    for side, of in sides.items():
        why = f": {of['reason']}" if "reason" in of else ""
        lines.append(f"True surface of {side.upper()}: {of['truth']}{why}.")
    if any("measured" in of for of in sides.values()):
        lines.append(
            "Distances to it are of up to 20 objects a class, measured is the share of it that has "
            f"a point within {facts['within']} of the unit ball."
        )
    return ["\n".join(lines)]


def _floors(facts: Numbers) -> list[str]:
    """Where both domains are in metres and know their floor."""
    if "floor_a" not in facts:
        return []
    heads = ("lowest [m]", "highest [m]", "thinnest side [m]", "plates")
    rows = [["class", *(f"{head} {side}" for head in heads for side in "AB")]]
    for cls in facts["floor_a"]:
        of = [facts[f"floor_{side}"][cls] for side in "ab"]
        cells = [f"{one[key][1]:.2f}" for key in ("low", "high", "thin") for one in of]
        rows.append([cls, *cells, *(f"{one['plates']:.0%}" for one in of)])
    return [
        "## Over the floor",
        _markdown(rows),
        f"Medians over the same clouds; plates are thinner than {100 * PLATE_M:.0f} cm. A source "
        "whose objects reach lower than the target's hides too little of them, or puts them on the "
        "floor where they stand on furniture.",
    ]
