"""The charts of a run's page, and its table of pseudo-labels.

Labels of the target that appear here judge a finished run; nothing is chosen by them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import pandas as pd

from qs3.runs.metrics import RoundRecord
from qs3.utils.pictures import BLUE, GREEN, GRID, ORANGE, RED, SOFT, blank

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def curves(title: str, history: pd.DataFrame, marked: Mapping[str, int]) -> Figure:
    """Loss, held-out accuracy in percent and learning rate over the epochs, phases shaded.

    Args:
        history: a row an epoch.
        marked: epochs (from 0) to draw a line at, by name.
    """
    figure = blank(8.5, 7.2, 130, constrained=True)
    figure.suptitle(title, fontsize=11)
    axes = figure.subplots(3, sharex=True, gridspec_kw={"height_ratios": (1.0, 1.0, 0.6)})
    epochs = history["epoch"] + 1  # people count from 1
    panels = {
        "training loss": [name for name in history if "loss" in name],
        "held-out accuracy in %": [name for name in history if name.endswith("_val/acc")],
        "learning rate": ["lr"],
    }
    for ax, (label, names) in zip(axes, panels.items(), strict=True):
        for name, colour in zip(names, (BLUE, ORANGE, GREEN, RED), strict=False):
            known = (100 if "acc" in name else 1) * history[name].dropna()
            ax.plot(epochs[known.index], known, ".-", color=colour, label=name, linewidth=1.3,
                    markersize=4)  # fmt: skip
        ax.set_ylabel(label)
        ax.grid(axis="y", color=GRID, linewidth=0.7)
        ax.tick_params(labelsize=9, color=GRID)
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)
        ax.spines[["left", "bottom"]].set_color(GRID)
    axes[1].set_ylim(0, 102)
    axes[2].set(ylim=(0, None), xlabel="epoch")
    for phase, of in history.groupby("phase")["epoch"]:
        for ax in axes[: 3 * (phase % 2 == 0)]:
            ax.axvspan(of.min() + 0.5, of.max() + 1.5, color="#f0f3f7", zorder=0, linewidth=0)
        axes[0].text(of.mean() + 1, 1.02, "warm-up" if phase == 0 else phase - 1, ha="center",
                     transform=axes[0].get_xaxis_transform(), fontsize=8.5,
                     color=SOFT)  # fmt: skip
    for (name, epoch), colour in zip(marked.items(), (RED, GREEN), strict=False):
        for ax in axes:
            ax.axvline(epoch + 1, color=colour, linestyle="--", linewidth=1.1,
                       label=f"{name}: epoch {epoch + 1}")  # fmt: skip
    for ax in axes[:2]:
        ax.legend(fontsize=8.5, frameon=False)
    return figure


def pseudo_labels(rounds: Sequence[RoundRecord], classes: Sequence[str]) -> pd.DataFrame:
    """Of each round (column): by class selected/confident and mu or the threshold; theta.

    And what they are worth: precision and recall know the target's labels, which judge alone.
    """
    columns = {}
    for one in rounds:
        kept, by_class = ("thresholds", one.thresholds) if one.mu is None else ("mu", one.mu)
        column: dict[str, Any] = {}
        for name in classes:
            share = f", {kept} {by_class[name]:.2f}" if by_class and name in by_class else ""
            column[name] = f"{one.selected.get(name, 0)}/{one.confident.get(name, 0)}{share}"
        column["theta"] = one.theta
        if one.agreement is not None:
            column["same label as before"] = one.agreement
        if judged := one.with_target_labels:
            column["precision (evaluation only)"] = judged.precision
            column["recall (evaluation only)"] = judged.recall
        columns[f"round {one.round}"] = column
    return pd.DataFrame(columns)
