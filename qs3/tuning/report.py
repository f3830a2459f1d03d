"""What a search found: a preset under conf/sensor, and a page beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from qs3.tuning.command import Found
from qs3.tuning.parameters import BOUNDS
from qs3.utils.files import write_text

_NEAR = 0.02  # of a range's logarithm: a value this near to its end is said to be there


def preset(found: Found, base: Sequence[str], command: str) -> str:
    """YAML of a sensor: another one's, with the tuned numbers in their places.

    Args:
        found: see the class.
        base: lines of its defaults list.
        command: that made it.
    """
    lines = [
        "# Tuned until its clouds are like those of an unlabelled target.",
        f"# {command}",
        "defaults:",
        *(f"  - {line}" for line in base),
        "  - _self_",
        "",
    ]
    own = {key: value for key, value in found.after.items() if "." not in key}
    inside = {k: v for k, v in found.after.items() if k.startswith("infrared.")}
    lines += [f"{key}: {value:.6g}" for key, value in own.items()]
    if inside:
        lines.append("infrared:")
        lines += [f"  {key.partition('.')[2]}: {value:.6g}" for key, value in inside.items()]
    return "\n".join(lines) + "\n"


def markdown(found: Found, command: str) -> str:
    """A page: distances before and after, the numbers, the history."""
    lines = [
        "# A tuned sensor",
        "",
        f"    {command}",
        "",
        f"Squared MMD of {found.features} to {found.counts['target']} unlabelled clouds of the "
        "target, by the ordinary sensor; the floor is what as many other clouds of the target have "
        "in the mean.",
        "",
        "| objects | | before | after | floor |",
        "|---|---|---|---|---|",
    ]
    for name, row in (("held out", found.held_out), ("searched with", found.trained_on)):
        figures = " | ".join(f"{row[key]:.4f}" for key in ("before", "after", "floor"))
        lines.append(f"| {name} | {int(row['objects'])} | {figures} |")
    lines += ["", "| number | range | before | after |", "|---|---|---|---|"]
    for key in found.keys:
        low, high = BOUNDS[key]
        before, after = (f"{values[key]:.4g}" for values in (found.before, found.after))
        at = _at_an_end(found.after[key], low, high)
        lines.append(f"| `{key}` | {low:g} to {high:g} | {before} | {after}{at} |")
    lines += [
        "",
        "Distances before each step, of that step's objects:",
        "",
        "    " + " ".join(f"{value:.4f}" for value in found.path),
        "",
    ]
    return "\n".join(lines)


def _at_an_end(value: float, low: float, high: float) -> str:
    span = high / low
    if value <= low * span**_NEAR:
        return " (the least)"
    return " (the most)" if value >= low * span ** (1 - _NEAR) else ""


def said(found: Found) -> list[str]:
    """A few lines for the terminal."""
    lines = [f"{'':28} {'before':>10} {'after':>10}"]
    for key in found.keys:
        lines.append(f"{key:28} {found.before[key]:>10.4g} {found.after[key]:>10.4g}")
    for name, row in (("held out", found.held_out), ("searched with", found.trained_on)):
        what = f"distance, {int(row['objects'])} {name}"
        lines.append(
            f"{what:28} {row['before']:>10.4f} {row['after']:>10.4f}   floor {row['floor']:.4f}"
        )
    if found.held_out["after"] >= found.held_out["before"]:
        lines.append(
            "by the ordinary sensor the distance of held-out objects did not fall: keep the preset"
        )
    return lines


def save(out: Path, found: Found, base: Sequence[str], command: str) -> list[Path]:
    """Write preset and page; returns their paths."""
    page = out.with_suffix(".md")
    write_text(out, preset(found, base, command))
    write_text(page, markdown(found, command))
    return [out, page]
