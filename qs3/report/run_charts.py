"""The charts of a run's page, and its table of pseudo-labels.

Labels of the target that appear here judge a finished run; nothing is chosen by them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from qs3.runs.metrics import RoundRecord
from qs3.utils.pictures import BLUE, GREEN, GRID, INK, ORANGE, RED, SOFT, blank

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SMALL: dict[str, Any] = {"fontsize": 8.5, "frameon": False}


def curves(title: str, history: pd.DataFrame, marked: Mapping[str, int]) -> Figure:
    """Loss, held-out accuracy in percent and learning rate over the epochs, phases shaded.

    Args:
        history: a row an epoch.
        marked: epochs (from 0) to draw a line at, by name.
    """
    figure, axes = _figure(8.5, 7.2, title, (1.0, 1.0, 0.6))
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
        ax.legend(**_SMALL)
    return figure


def embedding(
    title: str,
    features: Mapping[str, Float[np.ndarray, "n d"]],
    labels: Int[np.ndarray, " n"],
    domain: Int[np.ndarray, " n"],
    names: Sequence[str],
    domains: Sequence[str],
) -> Figure:
    """Both domains' features on the plane of their PCA, a panel for each net by its title.

    Args:
        labels: class; -1 unknown, drawn nearly black.
        domain: 0 source (circles), 1 target (filled).
        names, domains: of the classes and of the two domains.
    """
    from matplotlib import colormaps

    figure, axes = _figure(6.4 * len(features) + 1.7, 5.9, title, (1,), len(features))
    colours = colormaps["tab10" if len(names) <= 10 else "gist_ncar"]
    picked = {name: colours(k if len(names) <= 10 else 0.95 * k / len(names))
              for k, name in enumerate(names)}  # fmt: skip
    for ax, (heading, found) in zip(axes, features.items(), strict=True):
        xy = pca(found)
        for k, (name, colour) in enumerate([*picked.items(), ("unknown class", INK)]):
            of = labels == (k if k < len(names) else -1)
            for d, marker in enumerate("o^"):
                ax.scatter(*xy[of & (domain == d)].T, s=15, marker=marker, edgecolors=[colour],
                           linewidths=0.7, facecolors=colour if d else "none", alpha=0.85,
                           label=name if d and of.any() else None)  # fmt: skip
        ax.set(xticks=[], yticks=[], xlabel=f"circles: {domains[0]}; triangles: {domains[1]}")
        ax.set_title(heading, fontsize=10)
    axes[-1].legend(**_SMALL, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


def pca(features: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n 2"]:
    """Coordinates along the two directions of largest variance.

    Signs are fixed (the largest entry of a direction is positive), so the result is repeatable.
    """
    centred = features - features.mean(axis=0)
    directions = np.linalg.svd(centred, full_matrices=False)[2][:2]
    largest = np.take_along_axis(directions, np.abs(directions).argmax(axis=1)[:, None], axis=1)
    return centred @ (directions * np.where(largest < 0, -1.0, 1.0)).T


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


def _figure(
    width: float, height: float, title: str, heights: Sequence[float], columns: int = 1
) -> tuple[Figure, list[Any]]:
    """A figure with its axes in row order; sizes in inches."""
    figure = blank(width, height, 130, constrained=True)
    axes = figure.subplots(len(heights), columns, squeeze=False, sharex=len(heights) > 1,
                           gridspec_kw={"height_ratios": heights})  # fmt: skip
    for ax in axes.flat:
        ax.tick_params(labelsize=9, color=GRID)
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)
        ax.spines[["left", "bottom"]].set_color(GRID)
    figure.suptitle(title, fontsize=11)
    return figure, list(axes.flat)
