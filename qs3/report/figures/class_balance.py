"""The class balance of domains: how many clouds each class has in each split, as bars."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from qs3.errors import DataError
from qs3.report.figures.canvas import grouped_bars, new_figure, say
from qs3.store.store import PointSet
from qs3.utils.plotting import BLUE, INK, PALE_BLUE, save_png
from qs3.utils.plural import counted

_COLOURS = {"train": BLUE, "test": PALE_BLUE}


def class_picture(domains: Mapping[str, PointSet], path: str | Path) -> Path:
    """Save a row of bars for each domain (by title): a bar a class and split, with its count."""
    if not domains:
        raise DataError("a picture of no domains")
    figure, axes = new_figure(10, 0.4 + 2.3 * len(domains), len(domains), 1)
    for ax, (title, data) in zip(axes, domains.items(), strict=True):
        ax.set_title(f"{title}: {_summary(data)}", fontsize=10, color=INK, loc="left")
        if not data.labelled:
            say(ax, "no labels")
            continue
        counts = {
            split: np.array([of_class.get(name, 0) for name in data.classes])
            for split, of_class in data.counts().items()
        }
        grouped_bars(ax, data.classes, counts, [_COLOURS[split] for split in counts])
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
            said.append(f"none of {counted(none, 'class', 'classes')}")
        words.append(f"{total:,} {split}" + (f" ({', '.join(said)})" if said else ""))
    return ", ".join(words)
