"""The measured facts as tables for people: plain text, or Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from qs3.data.inspection import columns
from qs3.utils import text_table

Numbers = dict[str, Any]


def table(rows: Sequence[Sequence[str]], markdown: bool = False) -> str:
    """Rows of words, header first: the first column to the left, the others to the right."""
    if markdown:
        return "\n".join(text_table.markdown(rows, numbers=True))
    return "\n".join(text_table.aligned(rows, numbers=True, rule=False))


def of_domain(facts: Numbers) -> str:
    """Text about one domain (`facts.inspect`)."""
    counts, extents, copies = facts["counts"], facts["extents"], facts["copies"]
    spacing, up = facts["spacing"], facts["gravity"]
    parts = [
        f"{facts['domain']}: {facts['folder']}, {facts['variant']}",
        f"{counts['clouds']} clouds of {facts['points']} points; content {facts['sha256'][:16]}",
    ]
    if facts["looked_at"] < counts["clouds"]:
        parts.append(
            f"sizes and spacing: of {facts['looked_at']} clouds drawn with seed {facts['seed']} "
            "(sample=N for more)"
        )
    parts += ["", "clouds", _counts(counts)]
    for split, of in counts["splits"].items():
        if of["largest_share"] is not None:
            parts.append(
                f"{split}: {of['largest_class']} is {of['largest_share']:.1%}, "
                f"{of['largest_over_smallest']:.1f} times the smallest class"
            )
    parts += columns.text(facts["columns"])
    parts += _measured(facts["valid_points"])
    unit = "unit ball" if extents["in_unit_ball"] else "as stored"
    parts += [
        "",
        f"size ({unit}), spacing, density and coverage: medians",
        _sizes(extents, spacing),
    ]
    parts += [
        "spacing: to the nearest other point in units of the unit ball (5 %, median, 95 %), and as "
        "stored; cv: standard deviation over mean of the spacing, and of the points in a voxel of "
        "1/8; seen: share of 72 directions from the centroid with a point, of the lowest 24; "
        "lonely: share of points far from all others",
        f"centroid off the origin {extents['centroid_offset_median']:.3g}, floor at "
        f"{extents['floor_median']:.3g} (medians)",
    ]
    if odd := extents["odd_sizes"]:
        parts.append(f"odd sizes for their class: {len(odd)}: {_some(odd)}")
    parts += ["", "which way is up, by the shape", _ups(up), *_ups_in_words(up)]
    parts += ["", "copies", *_copies(copies, spacing["all"]["copies"])]
    return "\n".join(parts)


def of_pair(facts: Numbers, markdown: bool = True) -> str:
    """Text about two domains (`facts.compare`), Markdown or plain."""
    a, b = facts["a"], facts["b"]
    head = "## " if markdown else ""

    def section(title: str, rows: list[list[str]], *notes: str) -> list[str]:
        return [f"{head}{title}", "", table(rows, markdown), "", *notes, *([""] if notes else [])]

    parts = [f"{'# ' if markdown else ''}A = {a}, B = {b}", ""]
    prior = facts["prior"]
    rows = [["class", "A", "B", "B - A"]]
    rows += [
        [cls, f"{p:.1%}", f"{q:.1%}", f"{100 * (q - p):+.1f}"]
        for cls, (p, q) in prior["by_class"].items()
    ]
    parts += section(
        "Class frequencies",
        rows,
        f"Total variation {prior['total_variation']:.3f} (0: equal, 1: disjoint).",
    )
    parts += section(
        "The gap at a glance",
        _glance(facts),
        f"Clouds of {facts['points']} points in the unit ball, as a net sees them: by farthest "
        "point sampling where more are stored. Medians of up to 60 clouds a class, drawn with "
        f"seed {facts['seed']}.",
        *_truths(facts),
    )
    parts += section(
        "By class", _by_class(facts), "Medians; up is by the shape, `?` where it is open."
    )
    apart = facts["told_apart"]
    parts += section(
        "Told apart by their nearest neighbours",
        [["by", "own domain"], *([by, f"{apart[by]:.1%}"] for by in ("all", "shape", "density"))],
        "Share of clouds whose most similar cloud is of their own domain (50 %: cannot be told "
        f"apart, 100 %: two worlds). {apart['clouds']} clouds of each, equally many a class.",
    )
    return "\n".join(parts).rstrip() + "\n"


def _counts(counts: Numbers) -> str:
    splits = counts["splits"]
    names = list(next(iter(splits.values()))["by_class"])
    rows = [["class", *splits, "all"]]
    for cls in names:
        numbers = [of["by_class"][cls] for of in splits.values()]
        if sum(numbers):
            rows.append([cls, *map(str, numbers), str(sum(numbers))])
    if counts["unlabelled"]:
        hidden = [of["clouds"] - sum(of["by_class"].values()) for of in splits.values()]
        rows.append(["unlabelled", *map(str, hidden), str(sum(hidden))])
    numbers = [of["clouds"] for of in splits.values()]
    return table([*rows, ["all", *map(str, numbers), str(sum(numbers))]])


def _measured(valid: Numbers) -> list[str]:
    found = []
    if valid["known"]:
        found.append(
            f"points before sampling: {valid['median']:.0f} (median), at least {valid['min']}; "
            f"{valid['repeating']} clouds have too few and repeat some"
        )
    left = valid["left_out"]
    return found + [f"left out: {n} {status}" for status, n in left.items()]


def _sizes(extents: Numbers, spacing: Numbers) -> str:
    rows = [
        ["class", "x", "y", "z", "largest side", "spacing", "as stored", "cv", "cv voxel", "seen",
         "below", "lonely"]
    ]  # fmt: skip
    for cls, size in extents["by_class"].items():
        of = spacing["by_class"][cls]
        rows.append(
            [cls, *(_number(v) for v in size["size_median"]),
             f"{_number(size['largest_side_min'])}..{_number(size['largest_side_max'])}",
             *_spaced(of)]
        )  # fmt: skip
    all_sizes = [_number(v) for v in extents["size_median"]]
    return table([*rows, ["all", *all_sizes, "", *_spaced(spacing["all"])]])


def _spaced(of: Numbers) -> list[str]:
    return [
        f"{of['nn_low']:.3f} {of['nn_median']:.3f} {of['nn_high']:.3f}",
        _number(of["nn_median_raw"]),
        f"{of['nn_variation']:.2f}",
        f"{of['voxel_variation']:.2f}",
        f"{of['directions']:.0%}",
        f"{of['below']:.0%}",
        f"{of['lonely']:.2%}",
    ]


def _ups(up: Numbers) -> str:
    rows = [["class", "up", "clouds", "along this axis", "this way, not the other", "evidence"]]
    for cls, of in up["by_class"].items():
        evidence = "clear" if of["axis_sure"] and of["sign_sure"] else "of the axis only"
        rows.append(
            [cls, _up(of), str(of["clouds"]), f"{of['axis_share']:.0%}", f"{of['sign_share']:.0%}",
             evidence if of["axis_sure"] else "weak"]
        )  # fmt: skip
    return table(rows)


def _up(of: Numbers) -> str:
    """Direction as far as the shape tells it: `+z`, `z?` without its sign, or `?`."""
    if not of["axis_sure"]:
        return "?"
    return str(of["up"]) if of["sign_sure"] else f"{of['up'][1]}?"


def _ups_in_words(up: Numbers) -> list[str]:
    if not up["by_class"]:
        return ["unknown: no clouds with labels of the ten classes"]
    if up["contradicting"]:
        return [
            f"WARNING: {', '.join(up['contradicting'])} do not stand upright on z. A wrong axis "
            "costs tens of points of accuracy: check the importer's `up`"
        ]
    return ["no class contradicts z up; judged against the embedded catalogue's upright shapes"]


def _copies(copies: Numbers, points: float) -> list[str]:
    lines = [f"points that repeat another one of their cloud: {points:.2%}"]
    lines.append(f"clouds that repeat another one: {copies['clouds']}")
    for group in copies["groups"][:5]:
        lines.append(f"  {' = '.join(group)}")
    if copies["leaks"]:
        lines.append(f"WARNING: {copies['leaks']} clouds of the test split are in another one, too")
    if copies["contradicting_labels"]:
        lines.append(f"WARNING: {copies['contradicting_labels']} of them have several labels")
    if copies["leaking_meshes"]:
        lines.append(f"WARNING: {copies['leaking_meshes']} meshes are in test and in another split")
    elif copies["meshes"]:
        lines.append(f"{copies['meshes']} different meshes, none in test and another split")
    return lines


_GLANCE = (
    ("nearest-neighbour spacing", "nn_median", "{:.4f}"),
    ("its coefficient of variation", "nn_variation", "{:.2f}"),
    ("variation of points a voxel (1/8)", "voxel_variation", "{:.2f}"),
    ("directions seen", "directions", "{:.0%}"),
    ("of the lowest third", "below", "{:.0%}"),
    ("repeated points", "copies", "{:.2%}"),
    ("lonely points", "lonely", "{:.2%}"),
)


def _glance(facts: Numbers) -> list[list[str]]:
    rows = [["", "A", "B"]]
    for words, key, form in _GLANCE:
        rows.append([words, *(form.format(facts[f"cloud_{s}"]["all"][key]) for s in "ab")])
    for words, key, form in (
        ("off the true surface, median", "median_ball", "{:.4f}"),
        ("off the true surface, 95 %", "p95_ball", "{:.4f}"),
        ("off the true surface, median, as stored", "median", "{:.4f}"),
        ("off the true surface, 95 %, as stored", "p95", "{:.4f}"),
        ("true surface measured", "measured", "{:.0%}"),
    ):
        of = [facts[f"surface_{s}"].get("all") for s in "ab"]
        if any(of):
            rows.append([words, *(form.format(o[key]) if o else "-" for o in of)])
    return rows


def _truths(facts: Numbers) -> list[str]:
    lines = []
    for side in "ab":
        of = facts[f"surface_{side}"]
        why = f": {of['reason']}" if "reason" in of else ""
        lines.append(f"True surface of {side.upper()}: {of['truth']}{why}.")
    if any("all" in facts[f"surface_{side}"] for side in "ab"):
        lines.append(
            "Distances to it are of up to 20 objects a class, measured is the share of it that has "
            f"a point within {facts['within']} of the unit ball."
        )
    return lines


def _by_class(facts: Numbers) -> list[list[str]]:
    rows = [["class", "up A", "up B", "size A", "size B", "cv A", "cv B", "seen A", "seen B",
             "off A, 95 %", "off B, 95 %", "measured A", "measured B"]]  # fmt: skip
    for cls in facts["cloud_a"]["by_class"]:
        row = [cls]
        for side in "ab":
            of = facts[f"gravity_{side}"]["by_class"].get(cls)
            row.append(_up(of) if of else "?")
        for side in "ab":
            size = facts[f"extents_{side}"]["by_class"][cls]["size_median"]
            row.append(" x ".join(f"{v:.2f}" for v in size))
        for key, form in (("nn_variation", "{:.2f}"), ("directions", "{:.0%}")):
            row += [form.format(facts[f"cloud_{s}"]["by_class"][cls][key]) for s in "ab"]
        for key, form in (("p95_ball", "{:.3f}"), ("measured", "{:.0%}")):
            for side in "ab":
                known = facts[f"surface_{side}"].get("by_class", {}).get(cls)
                row.append(form.format(known[key]) if known else "-")
        rows.append(row)
    return rows


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
