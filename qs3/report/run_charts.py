"""The charts of one run. Each is a figure, or the reason in words why there is none.

Labels of the target that appear here judge a finished run; nothing is chosen by them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from qs3.evaluation.calibration import CALIBRATION_BINS, reliability
from qs3.report.run_files import RunFiles
from qs3.utils.pictures import BLUE, GREEN, GRID, INK, ORANGE, PALE_BLUE, RED, SOFT, blank

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EVALUATION_ONLY = "with target labels, evaluation only"
_DPI = 130


def axes_of_figure(
    width: float, height: float, rows: int, columns: int, title: str = "", **grid: Any
) -> tuple[Figure, list[Any]]:
    """A figure with its axes in row order; sizes in inches."""
    figure = blank(width, height, _DPI, constrained=True)
    axes = list(np.ravel(figure.subplots(rows, columns, squeeze=False, **grid)))
    for ax in axes:
        ax.tick_params(labelsize=9, color=GRID)
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)
        ax.spines[["left", "bottom"]].set_color(GRID)
    figure.suptitle(title, fontsize=11)
    return figure, axes


def curves(run: RunFiles) -> Figure | str:
    """Loss, held-out accuracy in percent and learning rate over the epochs, phases shaded."""
    history, metrics = run.history, run.metrics
    if history is None:
        return "no epoch is done yet"
    figure, axes = axes_of_figure(
        8.5, 7.2, 3, 1, f"{run.title}: training", sharex=True,
        gridspec_kw={"height_ratios": (1.0, 1.0, 0.6)},
    )  # fmt: skip
    epochs = history["epoch"] + 1  # people count from 1
    losses = [name for name in history if "loss" in name]
    accuracies = [name for name in history if name.endswith("_val/acc")]
    panels = ((losses, 1, "training loss"), (accuracies, 100, "held-out accuracy in %"),
              (["lr"], 1, "learning rate"))  # fmt: skip
    for ax, (names, times, label) in zip(axes, panels, strict=True):
        for name, colour in zip(names, (BLUE, ORANGE, GREEN, RED) * len(names), strict=False):
            there = history[name].notna()
            ax.plot(epochs[there], times * history[name][there],
                    ".-" if there.sum() <= 60 else "-", color=colour, label=name, linewidth=1.3,
                    markersize=4)  # fmt: skip
        ax.set_ylabel(label)
        ax.grid(axis="y", color=GRID, linewidth=0.7)
    axes[1].set_ylim(0, 102)
    axes[2].set(ylim=(0, None), xlabel="epoch")
    axes[2].xaxis.get_major_locator().set_params(integer=True)
    spans = history.groupby("phase")["epoch"].agg(["min", "max"])
    every = max(1, len(spans) // 8)
    for phase, (first, last) in spans.iterrows():
        for ax in axes:
            if phase % 2 == 0:
                ax.axvspan(first + 0.5, last + 1.5, color="#f0f3f7", zorder=0, linewidth=0)
        if phase <= 1 or (phase - 1) % every == 0:
            words = f"round {phase - 1}" if phase and len(spans) < 7 else f"{phase - 1}"
            axes[0].text((first + last) / 2 + 1, 1.02, words if phase else "warm-up", ha="center",
                         transform=axes[0].get_xaxis_transform(), fontsize=8.5,
                         color=SOFT)  # fmt: skip
    if metrics is not None:
        chosen = [("teacher", metrics.warmup.selected, RED), ("student", metrics.student, GREEN)]
        for who, one, colour in chosen:
            if one is not None and one.epoch >= 0:
                for ax in axes:
                    ax.axvline(one.epoch + 1, color=colour, linestyle="--", linewidth=1.1,
                               label=f"{who}: epoch {one.epoch + 1}")  # fmt: skip
    for ax in axes[:2]:
        ax.legend(fontsize=8.5, frameon=False, loc="best")
    return figure


def confusion(run: RunFiles) -> Figure | str:
    """Counts, and percent of each true class, of the reported result."""
    if run.metrics is None or run.metrics.final.confusion is None:
        return "the run is not finished" if run.metrics is None else "the target has no labels"
    f, names = run.metrics.final, run.classes
    matrix = np.array(f.confusion)
    support = matrix.sum(axis=1)
    share = matrix / np.where(support, support, 1)[:, None]
    few = len(names) <= 20
    side = max(4.6, 0.62 * len(names)) if few else 0.3 * len(names)
    figure, (ax,) = axes_of_figure(
        side + 2.2, side + 1.5, 1, 1,
        f"{run.title}, on {run.target}\naccuracy {f.accuracy:.1%}, balanced "
        f"{f.balanced_accuracy:.1%}, majority rate {f.majority_rate:.1%}, {f.n} clouds",
    )  # fmt: skip
    rows = [f"{name} ({n})" for name, n in zip(names, support, strict=True)]
    words = [[f"{n}\n{s:.0%}" if n and few else str(n or "") for n, s in zip(*pair, strict=True)]
             for pair in zip(matrix, share, strict=True)]  # fmt: skip
    image = _cells(ax, share, words, rows, names, size=8 if few else 6)
    ax.set(xlabel="predicted class", ylabel="true class (clouds)")
    figure.colorbar(image, ax=ax, fraction=0.04, pad=0.02, label="share of the true class")
    return figure


def pseudo_labels(run: RunFiles) -> Figure | str:
    """By round and class: selected of confident, mu (or thresholds); theta and what they are worth.

    Precision and recall know the target's labels: they judge, and nothing is chosen by them.
    """
    if not run.rounds:
        return "the run has no rounds of self-training"
    names, rounds = run.classes, run.rounds

    def by_round(key: str) -> Float[np.ndarray, "c r"]:
        return np.array([one.counts(names, key) for one in rounds]).T

    chosen, sure = by_round("selected"), by_round("confident")
    kept = "thresholds" if np.isnan(by_round("mu")).all() else "mu"
    high, wide = max(3.4, 0.32 * len(names) + 1.0), max(3.2, 0.62 * len(rounds) + 1.2)
    figure, axes = axes_of_figure(
        2 * wide + 2.4, high + 3.6, 2, 2, f"{run.title}: pseudo-labels of {run.target}",
        gridspec_kw={"height_ratios": (high, 2.6)},
    )  # fmt: skip
    numbers, x = [str(one.number) for one in rounds], np.arange(len(rounds))
    words = [["?" if np.isnan(n) else f"{n:.0f}" + (f"/{m:.0f}" if m >= 0 else "")
              for n, m in zip(*pair, strict=True)]
             for pair in zip(chosen, sure, strict=True)]  # fmt: skip
    _cells(axes[0], chosen / max(np.nan_to_num(chosen).max(), 1), words, names, numbers)
    axes[0].set_title("clouds selected / confident", fontsize=10)
    shares = by_round(kept)
    _cells(axes[1], shares, [[f"{v:.2f}" for v in row] for row in shares], names, numbers)
    title = {"mu": "mu, the share kept of each class", "thresholds": "threshold of each class"}
    axes[1].set_title(title[kept], fontsize=10)
    axes[2].bar(x, np.nansum(sure, axis=0), 0.72, color=PALE_BLUE, label="confident")
    axes[2].bar(x, np.nansum(chosen, axis=0), 0.44, color=BLUE, label="selected")
    axes[2].set_ylabel("clouds")
    for key, style, colour, label in (
        ("theta", "o-", INK, "theta, the confidence asked for"),
        ("agreement", "s-", GREEN, "same label as in the round before"),
        ("precision", "o--", ORANGE, f"precision ({EVALUATION_ONLY})"),
        ("recall", "s--", RED, f"recall ({EVALUATION_ONLY})"),
    ):
        judged = [getattr(one.record, "with_target_labels", None) for one in rounds]
        of = [one.record for one in rounds] if hasattr(rounds[0].record, key) else judged
        values = np.array([getattr(one, key, None) for one in of], dtype=float)
        if np.isfinite(values).any():
            axes[3].plot(x, values, style, color=colour, label=label, markersize=4.5)
    axes[3].set(ylim=(0, 1.03), ylabel="share")
    for ax in axes[2:]:
        ax.set_xticks(x, numbers)
        ax.set_xlim(-0.6, len(rounds) - 0.4)
        if ax.get_legend_handles_labels()[0]:
            ax.legend(fontsize=8, ncols=2 if ax is axes[2] else 1, frameon=False,
                      loc="lower center", bbox_to_anchor=(0.5, 1.0))  # fmt: skip
    for ax in axes:
        ax.set_xlabel("round")
    return figure


def classes(run: RunFiles, train_labels: Int[np.ndarray, " n"] | None = None) -> Figure | str:
    """How many clouds of each class the target's splits have, and how many were predicted.

    `train_labels` of its training clouds, if known, are shown and nothing else.
    """
    panels: dict[str, dict[str, np.ndarray]] = {}
    c, true = len(run.classes), f"true ({EVALUATION_ONLY})"
    train = {} if train_labels is None else {true: np.bincount(train_labels, minlength=c)}
    last = next((one for one in reversed(run.rounds) if one.labels is not None), None)
    if last is not None:
        train[f"named by the teacher of round {last.number}"] = last.counts(run.classes, "named")
        train["selected"] = last.counts(run.classes, "selected")
    if train:
        panels["training split"] = train
    if (p := run.predictions) is not None:
        known = p.labels[p.labels >= 0]
        test = {true: np.bincount(known, minlength=c)} if len(known) else {}
        test["predicted by the result"] = np.bincount(p.predicted, minlength=c)
        split = run.metrics.evaluation.split if run.metrics else "test"
        panels[f"{split} split{', evaluated' if split == 'train' else ''}"] = test
    if not panels:
        return "there are neither predictions nor pseudo-labels"
    figure, axes = axes_of_figure(
        max(6.5, 0.55 * c + 1.5), 3.1 * len(panels) + 0.7, len(panels), 1,
        f"{run.title}: classes of {run.target}",
    )  # fmt: skip
    for ax, (title, bars) in zip(axes, panels.items(), strict=True):
        grouped_bars(ax, run.classes, bars)
        ax.set_title(title, fontsize=10, loc="left")
    return figure


def calibration(run: RunFiles) -> Figure | str:
    """Reliability diagram of the result, and how many clouds each bin holds."""
    p = run.predictions
    if p is None or not np.isfinite(p.probabilities).all():
        return "there are no predictions" if p is None else "the net has diverged"
    found = reliability(p.probabilities, p.labels)
    if found is None:
        return "the target has no labels"
    figure, (upper, lower) = axes_of_figure(
        5.6, 6.6, 2, 1,
        f"{run.title}: calibration on {run.target}\nexpected calibration error "
        f"{100 * found.error:.1f}% in {CALIBRATION_BINS} bins\n({EVALUATION_ONLY})",
        sharex=True, gridspec_kw={"height_ratios": (3.2, 1.0)},
    )  # fmt: skip
    centre, wide = (np.arange(CALIBRATION_BINS) + 0.5) / CALIBRATION_BINS, 0.92 / CALIBRATION_BINS
    some = found.count > 0
    upper.plot([0, 1], [0, 1], color=INK, linewidth=1, linestyle=":", label="perfectly calibrated")
    upper.bar(centre[some], found.accuracy[some], wide, color=BLUE, label="accuracy")
    upper.plot(found.confidence[some], found.accuracy[some], "o", color=ORANGE, markersize=5,
               label="at the mean confidence")  # fmt: skip
    upper.set(ylim=(0, 1.02), ylabel="share that is right")
    upper.legend(fontsize=8.5, frameon=False, loc="upper left")
    lower.bar(centre, found.count, wide, color=PALE_BLUE)
    lower.set(ylabel="clouds", xlabel="confidence: the largest class probability", xlim=(0, 1))
    return figure


def pca(features: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n 2"]:
    """Coordinates along the two directions of largest variance.

    Signs are fixed (the largest entry of a direction is positive), so the result is repeatable.
    """
    centred = features - features.mean(axis=0)
    directions = np.linalg.svd(centred, full_matrices=False)[2][:2]
    largest = np.take_along_axis(directions, np.abs(directions).argmax(axis=1)[:, None], axis=1)
    return centred @ (directions * np.where(largest < 0, -1.0, 1.0)).T


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
        domain: 0 source, 1 target.
        names, domains: of the classes and of the two domains.
    """
    from matplotlib import colormaps
    from matplotlib.lines import Line2D

    figure, axes = axes_of_figure(5.3 * len(features) + 1.7, 5.9, 1, len(features), title)
    colours = colormaps["tab10" if len(names) <= 10 else "gist_ncar"]
    picked = [colours(k if len(names) <= 10 else 0.95 * k / len(names)) for k in range(len(names))]
    handles = []
    for d, marker in enumerate("o^"):
        for ax, (heading, found) in zip(axes, features.items(), strict=True):
            xy = pca(found)
            for k, colour in enumerate([*picked, INK]):
                of = (domain == d) & (labels == (k if k < len(names) else -1))
                ax.scatter(*xy[of].T, s=15, marker=marker, edgecolors=[colour], linewidths=0.7,
                           facecolors=colour if d else "none", alpha=0.85)  # fmt: skip
            ax.set(xticks=[], yticks=[])
            ax.set_title(heading, fontsize=10)
        handles.append(Line2D([], [], linestyle="", marker=marker, color=INK, label=domains[d],
                              markerfacecolor=INK if d else "none"))  # fmt: skip
    handles += [Line2D([], [], linestyle="", marker="s", color=colour, label=name)
                for name, colour in zip(names, picked, strict=True)]  # fmt: skip
    figure.legend(handles=handles, loc="outside right center", fontsize=8.5, frameon=False)
    return figure


def grouped_bars(ax: Any, names: Sequence[str], groups: Mapping[str, np.ndarray]) -> None:
    """How many clouds each name has: a bar of each of `groups`, with its count if there is room."""
    place, wide = np.arange(len(names)), 0.8 / len(groups)
    for i, (label, counts) in enumerate(groups.items()):
        at = place + (i - (len(groups) - 1) / 2) * wide
        bars = ax.bar(
            at, counts, wide, label=label, color=(INK, BLUE, PALE_BLUE)[-len(groups) :][i]
        )
        if len(names) <= 20:
            ax.bar_label(bars, fmt="{:,.0f}", fontsize=7, color=SOFT, padding=1)
    turn = 0 if len(names) <= 6 else 30 if len(names) <= 20 else 60
    ax.set_xticks(place, names, fontsize=9, rotation=turn, ha="right" if turn else "center")
    ax.set_ylabel("clouds", fontsize=9, color=SOFT)
    ax.margins(x=0.01, y=0.14)
    ax.grid(axis="y", color=GRID, linewidth=0.7)
    ax.legend(fontsize=8.5, frameon=False, ncols=len(groups), loc="lower right",
              bbox_to_anchor=(1.0, 0.99))  # fmt: skip


def _cells(
    ax: Any,
    shades: Float[np.ndarray, "r c"],
    words: Sequence[Sequence[str]],
    rows: Sequence[str],
    columns: Sequence[str],
    size: float = 7.5,
) -> Any:
    """A table of words in cells, darker from 0 to 1."""
    image = ax.imshow(shades, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    long = any(len(name) > 3 for name in columns)
    small = 9 if len(rows) <= 20 else 7
    ax.set_xticks(range(len(columns)), columns, fontsize=small, rotation=40 if long else 0,
                  ha="right" if long else "center")  # fmt: skip
    ax.set_yticks(range(len(rows)), rows, fontsize=small)
    for (i, j), shade in np.ndenumerate(shades):
        ax.text(j, i, words[i][j], ha="center", va="center", fontsize=size,
                color="white" if shade > 0.55 else INK)  # fmt: skip
    return image
