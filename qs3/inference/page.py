"""The page of `qs3 predict`: what was right, what was wrong, and what was wrong with the clouds.

One HTML file with its pictures inside. With labels the errors come first, the most confident
before the others; without, what is in doubt.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Sequence
from html import escape

import numpy as np

from qs3.evaluation.ood import MEASURES, OF_HEIGHTS, OF_METRES
from qs3.inference.inputs import Sample
from qs3.inference.scores import DISPUTED, STRANGE, Count, Scores, disputed, kinds, right, scores
from qs3.inference.table import Row
from qs3.inference.thumbnails import around, cloud_png, depth_png
from qs3.utils import html
from qs3.utils.plural import counted
from qs3.utils.version import VERSION

MOST_SHOWN = 300
"""Objects with pictures; the others are in the table alone."""

_MEANINGS = {**MEASURES, **OF_METRES, **OF_HEIGHTS}
_FEW, _COLLAPSED = 20, 0.8
"""With so many predictions and such a share of one class the page has a caution."""

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #1d2430; margin: 1.6rem auto; padding: 0 1rem;
  max-width: 76rem; }
h1 { font-size: 1.45rem; margin-bottom: .2rem; } h2 { font-size: 1.12rem; margin: 1.8rem 0 .6rem; }
p { margin: .3rem 0; } .soft { color: #6b7482; } .note { color: #8a5a12; }
.big { font-size: 1.9rem; font-weight: 600; margin: .6rem 0 0; }
.side { display: flex; flex-wrap: wrap; gap: 1rem 3rem; align-items: flex-start; }
table { border-collapse: collapse; } th, td { padding: .15rem .7rem .15rem 0; text-align: left;
  border-bottom: 1px solid #e3e6eb; } th { font-weight: 500; color: #6b7482; }
td.n { text-align: right; font-variant-numeric: tabular-nums; }
.matrix td, .matrix th { padding: .15rem .4rem; text-align: center; border: 1px solid #eef0f3; }
.matrix th.row { text-align: right; }
.matrix .hit { outline: 2px solid #3a8f5c; outline-offset: -2px; }
.cards { display: flex; flex-wrap: wrap; gap: .7rem; }
.card { border: 1px solid #e3e6eb; border-top: 4px solid #b9c0ca; border-radius: 4px;
  padding: .4rem; width: 168px; font-size: 13px; } .card.two { width: 342px; }
.card img { display: inline-block; width: 168px; height: 168px; object-fit: contain;
  background: #f7f8fa; } .card.two img + img { margin-left: 6px; }
.wrong { border-top-color: #b5403a; } .right { border-top-color: #3a8f5c; }
.said { font-size: 15px; font-weight: 600; } .wrong .said { color: #b5403a; }
.right .said { color: #2c7048; } .bar { display: block; height: 3px; background: #b9d0ea; }
.tag { display: inline-block; background: #fbf1e2; color: #7a4f0f; border-radius: 3px;
  padding: 0 .3rem; margin: .1rem .15rem 0 0; font-size: 12px; }
.file { color: #8a93a1; font-size: 11px; overflow-wrap: anywhere; }
"""


class Gallery:
    """The rows that the page shows with pictures: those that come first, up to a number of them."""

    def __init__(self, classes: Sequence[str], most: int = MOST_SHOWN) -> None:
        self._classes, self._most = classes, most
        self._kept: list[tuple[tuple[float, ...], int, Row, Sample]] = []
        self._count = 0

    def add(self, row: Row, sample: Sample) -> None:
        """Offer a row with what it was made of."""
        self._count += 1
        first = (rank(row, self._classes), -self._count)
        full = len(self._kept) >= self._most
        if full and first <= self._kept[0][:2]:
            return
        if sample.picture:  # whole frames would be gigabytes
            sample = sample._replace(picture=around(*sample.picture))
        (heapq.heapreplace if full else heapq.heappush)(self._kept, (*first, row, sample))

    def shown(self) -> list[tuple[Row, Sample]]:
        """Those kept, in the order of the page."""
        return [(row, sample) for _, _, row, sample in sorted(self._kept, reverse=True)]

    def __len__(self) -> int:
        """All that were offered."""
        return self._count


def rank(row: Row, classes: Sequence[str]) -> tuple[float, ...]:
    """The larger, the earlier: confident errors, then right ones in doubt; then what has no label.

    Without a label what something is wrong with comes first, then what is least sure.
    """
    assert row.probabilities is not None
    sure, correct = float(np.max(row.probabilities)), right(row, classes)
    if correct is None:
        return (0.0, float(bool(kinds(row, classes))), -sure)
    return (2.0, 0.0, sure) if not correct else (1.0, 0.0, -sure)


def page(
    title: str,
    rows: Sequence[Row],
    gallery: Gallery,
    classes: Sequence[str],
    trained_on: str = "",
    worth: str = "",
    notes: Sequence[str] = (),
    verdict: str = "",
    floor_m: float | None = None,
) -> str:
    """The page as HTML.

    Args:
        title: what was predicted with what.
        rows: all of them.
        gallery: those with pictures.
        classes: names in the order of the probabilities.
        trained_on: what the net's data are made of; "" if nobody knows.
        worth: what it was found to be worth on real objects; likewise.
        notes: what was taken for granted: where the floor is, how common classes are.
        verdict: how many are expected to be right, without a look at labels; likewise.
        floor_m: z of the floor, if the net knows heights: cards say how high an object begins.
    """
    found = scores(rows, classes)
    failed = [row for row in rows if row.probabilities is None]
    parts = _head(found, rows, failed, classes)
    for note in notes:
        parts.append(f'<p class="note">{escape(note[:1].upper() + note[1:])}</p>')
    if verdict:
        parts.append(f'<p class="note">{escape(verdict)}</p>')
    if trained_on:
        parts.append(f'<p class="soft">The net\'s data: {escape(trained_on)}</p>')
    if worth:
        parts.append(f'<p class="note">What the net is worth: {escape(worth)}</p>')
    if found:
        parts.append(f'<div class="side">{_why(found)}{_matrix(found, classes)}</div>')
    shown = gallery.shown()
    unlabelled = "Without a label" + " that is a class of the net" * bool(found and found.unknown)
    for heading, note, wanted in (
        ("Wrong", "the most confident first", False),
        ("Right", "the least confident first", True),
        (unlabelled if found else "Predicted", "what is in doubt first", None),
    ):
        cards = [
            _card(row, of, classes, floor_m) for row, of in shown if right(row, classes) is wanted
        ]
        if cards:
            total = sum(
                row.probabilities is not None and right(row, classes) is wanted for row in rows
            )
            count = f"{len(cards)} of {total}" if len(cards) < total else str(total)
            parts.append(f'<h2>{heading}: {count} <span class="soft">{note}</span></h2>')
            parts.append(f'<div class="cards">{"".join(cards)}</div>')
    if failed:
        parts.append(f"<h2>Not predicted: {len(failed)}</h2>")
        parts.append(html.table([[row.file, row.reason] for row in failed[:MOST_SHOWN]]))
    parts.append(f'<p class="soft">qs3 {escape(VERSION)}</p>')
    return html.document(title, _STYLE, parts)


def _head(
    found: Scores | None, rows: Sequence[Row], failed: Sequence[Row], classes: Sequence[str]
) -> list[str]:
    """What is said before everything else."""
    said, often = len(rows) - len(failed), _commonest(rows, classes)
    if found is None:
        given = any(row.label and row.probabilities is not None for row in rows)
        labels = "No label given is a class of the net" if given else "No labels were given"
        return [
            f'<p class="big">{said} predicted</p>',
            f"<p>{labels}, so nobody knows which are right.</p>",
            *often,
        ]
    label, times = found.majority
    parts = [
        f'<p class="big">{found.all.right} of {found.all.of} right ({found.all.share:.0%})</p>',
        f"<p>Always saying {escape(label)} would be right {counted(times, 'time')} "
        f"({times / found.all.of:.0%}). Mean confidence is {found.confidence:.0%}: the net is "
        f"{_surety(found)}.</p>",
        *often,
    ]
    if found.tiers:
        words = ", ".join(f"{tier} {_of(count)}" for tier, count in found.tiers.items())
        parts.append(f"<p>By tier: {words}.</p>")
    if found.unknown:
        words = ", ".join(f"{escape(name)} {n}" for name, n in sorted(found.unknown.items()))
        parts.append(
            f'<p class="soft">Labels that are not classes of the net, not counted: {words}</p>'
        )
    if found.unlabelled:
        parts.append(f'<p class="soft">Without a label, not counted: {found.unlabelled}</p>')
    return parts


def _commonest(rows: Sequence[Row], classes: Sequence[str]) -> list[str]:
    """A warning if nearly all are called the same."""
    said = [int(row.probabilities.argmax()) for row in rows if row.probabilities is not None]
    ((best, times),) = Counter(said).most_common(1) or [(0, 0)]
    if len(said) < _FEW or times < _COLLAPSED * len(said):
        return []
    name = escape(classes[best])
    return [
        f'<p class="note">{times} of {len(said)} are called {name}: the net hardly tells these '
        "clouds apart. Is up right, and were its clouds like these?</p>"
    ]


def _surety(found: Scores) -> str:
    points = round(100 * (found.confidence - found.all.share))
    if abs(points) < 5:
        return "about as sure as it is right"
    return f"{abs(points)} points too {'sure' if points > 0 else 'unsure'}"


def _of(count: Count) -> str:
    return f"{count.right} of {count.of} ({count.share:.0%})"


def _why(found: Scores) -> str:
    """Right ones with and without each thing that can be wrong with a cloud."""
    if not found.kinds:
        return ""
    lines = [["", "right with it", "right without"]]
    lines += [[kind, _of(has), _of(lacks)] for kind, (has, lacks) in found.kinds.items()]
    return f"<div><h2>What was wrong with the clouds</h2>{html.table(lines, head='row')}</div>"


def _matrix(found: Scores, classes: Sequence[str]) -> str:
    """Labels by rows and predictions by columns, those that occur; darker is more of the row."""
    matrix = found.confusion
    there = [k for k in range(len(classes)) if matrix[k].sum() or matrix[:, k].sum()]
    head = "".join(f"<th>{escape(classes[k])}</th>" for k in there)
    lines = [f"<tr><th>is \\ called</th>{head}<th>right</th></tr>"]
    for i in there:
        total = int(matrix[i].sum())
        cells = []
        for j in there:
            count = int(matrix[i, j])
            red, green, blue = (58, 143, 92) if i == j else (181, 64, 58)
            tint = f"rgba({red},{green},{blue},{0.75 * count / max(total, 1):.2f})"
            hit = ' class="hit"' if i == j else ""
            cells.append(f'<td{hit} style="background:{tint}">{count or ""}</td>')
        name, share = escape(classes[i]), f"{matrix[i, i]} of {total}" if total else ""
        lines.append(f'<tr><th class="row">{name}</th>{"".join(cells)}<td>{share}</td></tr>')
    table = f'<table class="matrix">{"".join(lines)}</table>'
    return f"<div><h2>What was called what</h2>{table}</div>"


def _card(row: Row, sample: Sample, classes: Sequence[str], floor_m: float | None) -> str:
    """One object: pictures, what it was called and is, and what was wrong with its cloud."""
    assert row.probabilities is not None
    order = np.argsort(-row.probabilities, kind="stable")
    best, sure = classes[order[0]], float(row.probabilities[order[0]])
    correct = right(row, classes)
    style = {True: "right", False: "wrong", None: ""}[correct]
    images = [html.image(cloud_png(_z_up(sample)), "cloud")]
    if sample.picture:
        images.append(html.image(depth_png(*sample.picture), "depth image"))
    is_ = f" is {escape(row.label)}" if row.label and not correct else ""
    if row.label and row.label not in classes:
        is_ += " (no class of the net)"
    second = f"{escape(classes[order[1]])} {row.probabilities[order[1]]:.0%}"
    tags = [f'<span class="tag">{escape(caution.words)}</span>' for caution in row.cautions]
    tags += [_strange(words) for words in row.reason.split("; ") if words]
    if disputed(row, classes):
        tags.append(f'<span class="tag">{DISPUTED}: {escape(row.second)}</span>')
    tier = f", {row.tier}" if row.tier else ""
    points = counted(row.points or 0, "point")
    size = f"<br>{_size(_z_up(sample), floor_m)}" if sample.tier or sample.picture else ""
    return (
        f'<div class="card {style}{" two" * (len(images) > 1)}">{"".join(images)}'
        f'<span class="bar" style="width:{sure:.0%}"></span>'
        f'<div><span class="said">{escape(best)} {sure:.0%}</span>{is_}</div>'
        f'<div class="soft">then {second}</div><div>{"".join(tags)}</div>'
        f'<div class="file">{escape(row.file)}, {points}{tier}{size}</div></div>'
    )


def _strange(words: str) -> str:
    """A measure out of the range of training, explained when pointed at."""
    meaning = _MEANINGS.get(words.split(" ")[0], "")
    return f'<span class="tag" title="{escape(meaning)}">{STRANGE}: {escape(words)}</span>'


def _size(cloud: np.ndarray, floor_m: float | None) -> str:
    """How large it is: a chair's back and a monitor look alike when both fill their card.

    And how high it begins where the floor is known: what a net that knows heights goes by, too.
    """
    angles = np.linspace(0, np.pi, 18, endpoint=False)
    across = cloud[:, :2] @ np.stack([np.cos(angles), np.sin(angles)])  # [n, 18]
    size = f"{np.ptp(across, axis=0).max():.2f} m wide, {np.ptp(cloud[:, 2]):.2f} m high"
    if floor_m is None:
        return size
    return f"{size}, from {cloud[:, 2].min() - floor_m:.2f} m above the floor"


def _z_up(sample: Sample) -> np.ndarray:
    """[n, 3] float64, for pictures and sizes, whatever frame the net sees the cloud in."""
    from qs3.datasets.importers.base import turned

    cloud = np.asarray(sample.cloud, dtype=np.float64)[:, :3]
    if sample.world_from_camera is not None:
        return cloud @ np.asarray(sample.world_from_camera).T
    return turned(cloud, sample.axis)
