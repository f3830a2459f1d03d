"""The class balance of domains: how many clouds each class has in each split, as bars."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from qs3.data.store import PointSet
from qs3.errors import DataError
from qs3.report.figures.canvas import new_figure
from qs3.utils.plotting import BLUE, GRID, INK, PALE_BLUE, SOFT, save_png

_COLOURS = {"train": BLUE, "test": PALE_BLUE}


def class_picture(domains: Mapping[str, PointSet], path: str | Path) -> Path:
    """Save a row of bars for each domain, one bar a class and split, with its count.

    Args:
        domains: by title.
        path: of the PNG.

    Raises:
        DataError: no domains.
    """
    if not domains:
        raise DataError("a picture of no domains")
    figure, axes = new_figure(10, 0.4 + 2.3 * len(domains), len(domains), 1)
    for ax, (title, data) in zip(axes, domains.items(), strict=True):
        ax.set_title(f"{title}: {_summary(data)}", fontsize=10, color=INK, loc="left")
        if not data.labelled:
            ax.text(0.5, 0.5, "no labels", transform=ax.transAxes, ha="center", color=SOFT)
            ax.set(xticks=[], yticks=[])
            continue
        counts, place = data.counts(), np.arange(len(data.classes))
        width = 0.8 / len(counts)
        small = 7.5 if len(data.classes) * len(counts) <= 30 else 5.5
        for i, (split, of_class) in enumerate(counts.items()):
            numbers = np.array([of_class.get(name, 0) for name in data.classes])
            at = place + (i - (len(counts) - 1) / 2) * width
            ax.bar(at, numbers, width, color=_COLOURS[split], label=split)
            for x, number in zip(at, numbers, strict=True):
                ax.text(x, number, f"{number:,}", ha="center", va="bottom", fontsize=small,
                        color=SOFT)  # fmt: skip
        turned = len(data.classes) > 12
        ax.set_xticks(place, data.classes, fontsize=9, rotation=60 if turned else 0,
                      ha="right" if turned else "center")  # fmt: skip
        ax.set_ylabel("clouds", fontsize=9, color=SOFT)
        ax.margins(x=0.01, y=0.12)
        ax.grid(axis="y", color=GRID, linewidth=0.7)
        ax.legend(fontsize=8.5, frameon=False, ncols=2, loc="lower right",
                  bbox_to_anchor=(1.0, 0.99))  # fmt: skip
    save_png(figure, Path(path))
    return Path(path)


def _summary(data: PointSet) -> str:
    """Clouds of each split, and how much more common the commonest class is than the rarest."""
    words = []
    for split, of_class in data.counts().items():
        total = int((data.splits == split).sum())
        numbers = [of_class.get(name, 0) for name in data.classes] if data.labelled else []
        some = [number for number in numbers if number]
        said = [f"largest class / smallest {max(some) / min(some):.1f}"] if some else []
        if none := len(numbers) - len(some):
            said.append(f"none of {none} class{'es' if none > 1 else ''}")
        words.append(f"{total:,} {split}" + (f" ({', '.join(said)})" if said else ""))
    return ", ".join(words)
