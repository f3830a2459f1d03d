"""What `qs3 predict` says on the terminal."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from qs3.config.location import typed
from qs3.datasets.clouds import NOTHING
from qs3.datasets.pointed import LEVEL, PLANES
from qs3.evaluation.ood import OTHER_UNITS, other_units
from qs3.inference.inputs import passed_over
from qs3.inference.predictor import Predictor
from qs3.inference.pretrained import HEIGHTS
from qs3.inference.scores import Count, disputed, right, scores
from qs3.inference.settings import Inputs, Settings, Source
from qs3.inference.table import Row
from qs3.utils.plural import counted

_SHOWN = 10  # failures in the text for the terminal
_LINES = 8  # that an organised scan has at least


def told(
    rows: Sequence[Row],
    records: Sequence[Mapping[str, Any]],
    inputs: Inputs,
    predictor: Predictor,
    settings: Settings,
    seconds: float,
) -> list[str]:
    """What was done, for the terminal."""
    good = [one for one in records if one["status"] == "ok"]
    failed = [one for one in records if one["status"] == "failed"]
    counts = Counter(one["class"] for one in good)
    rate = len(good) / max(seconds, 1e-9)
    lines = [
        f"{counted(len(good), 'cloud')}, {rate:.1f} clouds a second, from "
        f"{counted(len(inputs.units), inputs.kind.removesuffix('s'))}"
    ]
    if inputs.part:
        lines.append(f"taken: {inputs.part}")
    if good:
        lines.append("predicted " + ", ".join(f"{name} {n}" for name, n in counts.most_common()))
        lines += _scored(rows, predictor.classes)
        lines += _no_class(rows, predictor.classes)
        strange = sum(one["out_of_range"] for one in good)
        lines.append(f"{strange} of them out of range (column out_of_range)")
        lines += filter(None, [other_units(one["reason"] for one in good)])
        lines += _several(rows, inputs)
    if cautioned := sum(one["caution"] is not None for one in good):
        lines.append(f"{cautioned} of them with a caution (column caution)")
    lines += _vertical(rows)
    if holed := [one["dropped"] for one in good if one["dropped"]]:
        files = inputs.kind == "files"
        of = counted(len(holed), "cloud" if files else "object")
        why = NOTHING if files else "without depth or stray"
        lines.append(f"left out of {of}: {counted(sum(holed), 'point')}, {why} (column dropped)")
    if drawn := sum(row.drawn for row in rows):
        lines.append(
            f"{counted(drawn, 'file is a mesh', 'files are meshes')}: points were drawn on "
            f"{'its surface' if drawn == 1 else 'their surfaces'}; to see "
            f"{'it as a sensor does: ' if drawn == 1 else 'them as a sensor does: '}"
            + typed("python generate.py meshes=FOLDER")
        )
    if predictor.in_metres and inputs.kind == "files":
        lines.append("the classifier knows real sizes: the files' coordinates were taken as metres")
    if predictor.needs_floor and settings.floor is None and settings.camera_height is None:
        lines.append(
            f"the classifier knows heights: the camera counts as {predictor.camera_height:g} m "
            "above the floor ("
            + ("camera_height=" if settings.depth else "floor=")
            + " says otherwise)"
        )
    if predictor.result.gravity == "none" and inputs.kind != "depth images":
        lines.append("the classifier was trained on clouds in the frame of their camera, not z up")
    if inputs.others:
        lines.append(passed_over(inputs.others))
    if failed:
        lines.append(f"{len(failed)} failed:")
        lines += [f"  {one['file']}: {one['reason']}" for one in failed[:_SHOWN]]
        lines += [f"  and {len(failed) - _SHOWN} more, see the table"] * (len(failed) > _SHOWN)
    return lines


def _scored(rows: Sequence[Row], classes: Sequence[str]) -> list[str]:
    """Right and wrong, if somebody gave labels."""
    found = scores(rows, classes)
    if found is None:
        return []

    def of(count: Count) -> str:
        return f"{count.right} of {count.of} ({count.share:.1%})"

    tiers = "".join(f"; {tier} {of(count)}" for tier, count in found.tiers.items())
    label, times = found.majority
    balanced = f", balanced {found.balanced:.1%}"
    return [f"right {of(found.all)}{balanced}{tiers}; always {label}: {times / found.all.of:.1%}"]


def _several(rows: Sequence[Row], inputs: Inputs) -> list[str]:
    """Arrays [m, n, 3] whose every cloud is odd: one organised scan of m lines, perhaps."""
    if inputs.kind != "files":
        return []
    of_file: dict[str, list[str]] = {}
    for row in rows:
        name, bracket, _ = row.file.rpartition("[")
        if bracket and name.endswith(".npy"):
            of_file.setdefault(name, []).append(row.reason)
    odd = [(name, found) for name, found in of_file.items() if len(found) >= _LINES and _odd(found)]
    return [
        f"{name} is an array of {len(found)} clouds, all out of range: if it is one organised "
        "scan, save it as array.reshape(-1, 3)"
        for name, found in odd[:_SHOWN]
    ]


def _odd(reasons: Sequence[str]) -> bool:
    return all(reason and OTHER_UNITS not in reason for reason in reasons)


def _no_class(rows: Sequence[Row], classes: Sequence[str]) -> list[str]:
    """Labels that no answer can be right for, which scores leave out."""
    said = (row.label for row in rows if row.probabilities is not None)
    counts = Counter(label for label in said if label and label not in classes).most_common()
    if not counts:
        return []
    shown = ", ".join(f"{label} {n}" for label, n in counts[:_SHOWN])
    more = f" and {len(counts) - _SHOWN} more" if len(counts) > _SHOWN else ""
    of = counted(sum(n for _, n in counts), "label")
    return [f"{of} left out, no class of the classifier: {shown}{more}"]


def _vertical(rows: Sequence[Row]) -> list[str]:
    """Where up was not given."""
    counts = Counter(row.up for row in rows)
    words = {
        PLANES: "fitted to the planes of the picture",
        LEVEL: "not known, so the camera counts as level",
    }
    return [
        f"up of {counts[how]}: {says}; up= tells it" for how, says in words.items() if counts[how]
    ]


def agreement(rows: Sequence[Row], classes: Sequence[str]) -> str:
    """How often the second classifier says the same, and, with labels, what that was worth."""
    asked = [row for row in rows if row.second]
    apart = [row for row in asked if disputed(row, classes)]
    same = len(asked) - len(apart)
    text = (
        f"a second classifier says the same of {same} of {len(asked)} (column second); where it "
        "does not, look yourself"
    )
    known = [(right(row, classes), disputed(row, classes)) for row in asked]
    for words, wanted in (("same", False), ("not", True)):
        judged = [
            correct for correct, differs in known if differs is wanted and correct is not None
        ]
        if judged:
            share = sum(judged) / len(judged)
            text += f"; {words}: {sum(judged)} of {len(judged)} right ({share:.1%})"
    return text


def chosen(name: str, source: Source) -> str:
    """Which classifier was taken because none was named, and what would take a better one."""
    if source.floor_known:
        return f"classifier: {name}, which comes with qs3 and knows sizes and heights (ckpt=)"
    why = f"; {source.floor.words}" if source.floor else ""
    return (
        f"classifier: {name}, which comes with qs3 (ckpt=); {source.tells} takes {HEIGHTS}, which "
        f"knows sizes and heights and is right more often{why}"
    )
