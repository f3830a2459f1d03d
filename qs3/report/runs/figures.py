"""The figures of one run. Each returns matplotlib's figure, or raises the reason why there is none.

Labels of the target that appear here judge a finished run; nothing is chosen by them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from qs3.evaluation.calibration import CALIBRATION_BINS, reliability
from qs3.report.figures.canvas import (
    NothingToDrawError,
    cell_text,
    cells,
    curve,
    grouped_bars,
    new_figure,
    say,
)
from qs3.report.runs.data import RunFiles
from qs3.utils.plotting import BLUE, GREEN, INK, ORANGE, PALE_BLUE, RED, SOFT

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EVALUATION_ONLY = "with target labels, evaluation only"
_ABOVE: dict[str, Any] = {"frameon": False, "loc": "lower center", "bbox_to_anchor": (0.5, 1.0)}


def curves(run: RunFiles) -> Figure:
    """Loss, held-out accuracy in percent and learning rate over the epochs, phases shaded."""
    history = run.history
    if history is None:
        raise NothingToDrawError("no epoch is done yet")
    figure, axes = new_figure(8.5, 7.2, 3, 1, sharex=True, heights=(1.0, 1.0, 0.6))
    colours = (BLUE, ORANGE, GREEN, RED)
    epochs = history.epoch + 1  # people count from 1
    for i, (name, values) in enumerate(history.loss.items()):
        curve(axes[0], epochs, values, colours[i % 4], name)
    for i, (name, values) in enumerate(history.accuracy.items()):
        curve(axes[1], epochs, 100 * values, colours[i % 4], name)
    curve(axes[2], epochs, history.learning_rate, SOFT, "lr")
    axes[0].set_ylabel("training loss")
    axes[1].set_ylabel("held-out accuracy in %")
    axes[2].set_ylabel("learning rate")
    axes[2].set_xlabel("epoch")
    axes[1].set_ylim(0, 102)
    axes[2].set_ylim(0, 1.05 * max(np.nan_to_num(history.learning_rate).max(), 1e-12))
    axes[2].ticklabel_format(axis="y", style="sci", scilimits=(-3, 3))
    spans = history.spans()
    every = max(1, len(spans) // 8)
    for phase, first, last in spans:
        for ax in axes:
            if phase % 2 == 0:
                ax.axvspan(first + 0.5, last + 1.5, color="#f0f3f7", zorder=0, linewidth=0)
        if phase <= 1 or (phase - 1) % every == 0:
            words = (
                "warm-up" if phase == 0 else f"round {phase - 1}" if len(spans) < 7 else phase - 1
            )
            middle, of_axes = (first + last) / 2 + 1, axes[0].get_xaxis_transform()
            axes[0].text(middle, 1.02, words, transform=of_axes,
                         ha="center", va="bottom", fontsize=8.5, color=SOFT)  # fmt: skip
    for epoch, words, colour in _marks(run):
        for ax in axes:
            ax.axvline(epoch, color=colour, linestyle="--", linewidth=1.1, label=words)
    axes[2].set_xlim(epochs.min() - 0.5, epochs.max() + 0.5)
    axes[2].xaxis.get_major_locator().set_params(integer=True)
    for ax in axes[:2]:
        ax.legend(fontsize=8.5, frameon=False, loc="best")
    figure.suptitle(f"{run.title}: training", fontsize=12)
    return figure


def _marks(run: RunFiles) -> list[tuple[int, str, str]]:
    """Epochs whose weights were chosen, counted from 1."""
    if run.metrics is None:
        return []
    found = []
    teacher, student = run.metrics.warmup.selected.epoch + 1, run.metrics.student
    if teacher > 0:
        found.append((teacher, f"teacher: epoch {teacher}", RED))
    if student is not None:
        found.append((student.epoch + 1, f"student: epoch {student.epoch + 1}", GREEN))
    return found


def confusion(run: RunFiles) -> Figure:
    """Counts, and percent of each true class, of the reported result."""
    f = run.final
    if f is None or f.confusion is None:
        raise NothingToDrawError(
            "the run is not finished" if run.metrics is None else "the target has no labels"
        )
    matrix, names = np.array(f.confusion), run.classes
    support = matrix.sum(axis=1)
    share = matrix / np.where(support, support, 1)[:, None]
    side = max(4.6, 0.62 * len(names)) if len(names) <= 20 else 0.3 * len(names)
    figure, axes = new_figure(side + 2.2, side + 1.5, 1, 1)
    ax = axes[0]
    rows = [f"{name} ({n})" for name, n in zip(names, support, strict=True)]
    image = cells(ax, share, rows, names, vmax=1.0)
    for (i, j), n in np.ndenumerate(matrix):
        if n:
            words = f"{n}\n{100 * share[i, j]:.0f}%" if len(names) <= 20 else str(n)
            cell_text(ax, j, i, words, share[i, j], 8 if len(names) <= 20 else 6)
    ax.set_xlabel("predicted class")
    ax.set_ylabel("true class (clouds)")
    bar = figure.colorbar(image, ax=ax, fraction=0.04, pad=0.02)
    bar.set_label("share of the true class in %")
    bar.set_ticks([0, 0.25, 0.5, 0.75, 1.0], labels=["0", "25", "50", "75", "100"])
    figure.suptitle(
        f"{run.title}, on {run.target}\naccuracy {f.accuracy:.1%}, balanced "
        f"{f.balanced_accuracy:.1%}, majority rate {f.majority_rate:.1%}, {f.n} clouds",
        fontsize=11,
    )
    return figure


def pseudo_labels(run: RunFiles) -> Figure:
    """By round and class: selected of confident, mu (or thresholds); theta and what they are worth.

    Precision and recall know the target's labels: they judge, and nothing is chosen by them.
    """
    if not run.rounds:
        yet = "" if run.metrics else " yet"
        raise NothingToDrawError(f"the run has no rounds of self-training{yet}")
    names, rounds = run.classes, run.rounds
    numbers = [str(r.number) for r in rounds]
    nothing = np.full(len(names), -1)
    chosen = np.array([_or(r.selected(names), nothing) for r in rounds]).T  # [C, R]
    sure = np.array([_or(r.confident(names), nothing) for r in rounds]).T
    high = max(3.4, 0.32 * len(names) + 1.0)
    wide = max(3.2, 0.62 * len(rounds) + 1.2)
    figure, axes = new_figure(2 * wide + 2.4, high + 3.6, 2, 2, heights=(high, 2.6))

    ax = axes[0]
    cells(ax, np.where(chosen < 0, np.nan, chosen), names, numbers, vmax=max(chosen.max(), 1))
    for (i, j), n in np.ndenumerate(chosen):
        words = "?" if n < 0 else f"{n}/{sure[i, j]}" if sure[i, j] >= 0 else str(n)
        cell_text(ax, j, i, words, n / max(chosen.max(), 1), 7.5)
    known = (sure >= 0).any()
    ax.set_title(f"clouds selected{' / confident' if known else ''}", fontsize=10)

    ax, (what, table) = axes[1], _per_class(run)
    if table is None:
        say(ax, "no figure per class\nin this scheme" if run.metrics else "run not finished")
    else:
        cells(ax, table, names, numbers, vmax=1.0)
        for (i, j), value in np.ndenumerate(table):
            cell_text(ax, j, i, f"{value:.2f}", value, 7.5)
        ax.set_title(what, fontsize=10)

    ax, x = axes[2], np.arange(len(rounds))
    if known:
        total = np.where(sure < 0, 0, sure).sum(axis=0)
        ax.bar(x, total, 0.72, color=PALE_BLUE, label="confident")
    ax.bar(x, np.where(chosen < 0, 0, chosen).sum(axis=0), 0.44, color=BLUE, label="selected")
    sizes = [len(r.labels) for r in rounds if r.labels is not None]
    if sizes:
        ax.axhline(max(sizes), color=INK, linewidth=1, linestyle=":", label="all target clouds")
    ax.set_ylabel("clouds")
    ax.legend(fontsize=8, ncols=3, columnspacing=1, **_ABOVE)

    ax, lines = axes[3], _worth(run)
    for values, style, colour, label in lines:
        ax.plot(x, values, style, color=colour, label=label, markersize=4.5, linewidth=1.4)
    ax.set_ylim(0, 1.03)
    ax.set_ylabel("share")
    if lines:
        ax.legend(fontsize=8, **_ABOVE)
    else:
        say(ax, "run not finished")
    for ax in axes[2:]:
        ax.set_xticks(x, numbers)
        ax.set_xlim(-0.6, len(rounds) - 0.4)
    for ax in axes:
        ax.set_xlabel("round")
    figure.suptitle(f"{run.title}: pseudo-labels of {run.target}", fontsize=12)
    return figure


def _per_class(run: RunFiles) -> tuple[str, np.ndarray | None]:
    titles = {"mu": "mu, the share kept of each class", "thresholds": "threshold of each class"}
    for key, title in titles.items():
        columns = [r.of_class(key, run.classes) for r in run.rounds]
        if any(column is not None for column in columns):
            unknown = np.full(len(run.classes), np.nan)
            return title, np.array([_or(column, unknown) for column in columns]).T
    return "", None


def _worth(run: RunFiles) -> list[tuple[list[float], str, str, str]]:
    """Values, style, colour and label of the lines over the rounds."""
    records = [r.record for r in run.rounds]
    lines = [
        ([_number(getattr(record, key, None)) for record in records], style, colour, label)
        for key, style, colour, label in (
            ("theta", "o-", INK, "theta, the confidence asked for"),
            ("agreement", "s-", GREEN, "same label as in the round before"),
        )
    ]
    judged = [record and record.with_target_labels for record in records]
    for key, style, colour in (("precision", "o--", ORANGE), ("recall", "s--", RED)):
        values = [_number(getattr(figures, key, None)) for figures in judged]
        lines.append((values, style, colour, f"{key} ({EVALUATION_ONLY})"))
    return [line for line in lines if np.isfinite(line[0]).any()]


def classes(run: RunFiles, train_labels: np.ndarray | None = None) -> Figure:
    """How many clouds of each class the target's splits have, and how many were predicted.

    `train_labels`: [n] classes of its training clouds, if known; they are shown and nothing else.
    """
    panels = class_counts(run, train_labels)
    if not panels:
        raise NothingToDrawError("there are neither predictions nor pseudo-labels")
    names = run.classes
    width = max(6.5, 0.55 * len(names) + 1.5)
    figure, axes = new_figure(width, 3.1 * len(panels) + 0.7, len(panels), 1)
    for ax, (title, bars) in zip(axes, panels.items(), strict=True):
        grouped_bars(ax, names, bars, (INK, BLUE, PALE_BLUE))
        ax.set_title(title, fontsize=10, loc="left")
    figure.suptitle(f"{run.title}: classes of {run.target}", fontsize=12)
    return figure


def class_counts(
    run: RunFiles, train_labels: np.ndarray | None = None
) -> dict[str, dict[str, np.ndarray]]:
    """What `classes` draws: panel, then bar's label, then [C] clouds."""
    panels: dict[str, dict[str, np.ndarray]] = {}
    c = len(run.classes)
    train: dict[str, np.ndarray] = {}
    if train_labels is not None:
        train[f"true ({EVALUATION_ONLY})"] = np.bincount(train_labels, minlength=c)
    with_table = [r for r in run.rounds if r.labels is not None]
    if with_table:
        last = with_table[-1]
        for label, counts in (
            (f"named by the teacher of round {last.number}", last.named(run.classes)),
            ("selected", last.selected(run.classes)),
        ):
            assert counts is not None
            train[label] = counts
    if train:
        panels["training split"] = train
    if run.predictions is not None:
        p, test = run.predictions, {}
        if (p.labels >= 0).any():
            test[f"true ({EVALUATION_ONLY})"] = np.bincount(p.labels[p.labels >= 0], minlength=c)
        test["predicted by the result"] = np.bincount(p.predicted, minlength=c)
        split = run.metrics.evaluation.split if run.metrics else "test"
        panels[f"{split} split{', evaluated' if split == 'train' else ''}"] = test
    return panels


def calibration(run: RunFiles) -> Figure:
    """Reliability diagram of the result, and how many clouds each bin holds."""
    if run.predictions is None:
        raise NothingToDrawError("there is no predictions.csv")
    if not np.isfinite(run.predictions.probabilities).all():
        raise NothingToDrawError("the net has diverged: its probabilities are no numbers")
    found = reliability(run.predictions.probabilities, run.predictions.labels)
    if found is None:
        raise NothingToDrawError("the target has no labels")
    figure, axes = new_figure(5.6, 6.6, 2, 1, sharex=True, heights=(3.2, 1.0))
    centre, wide = (np.arange(CALIBRATION_BINS) + 0.5) / CALIBRATION_BINS, 0.92 / CALIBRATION_BINS
    some = found.count > 0
    upper, lower = axes
    upper.plot([0, 1], [0, 1], color=INK, linewidth=1, linestyle=":", label="perfectly calibrated")
    upper.bar(centre[some], found.accuracy[some], wide, color=BLUE, label="accuracy")
    upper.plot(found.confidence[some], found.accuracy[some], "o", color=ORANGE, markersize=5,
               label="at the mean confidence")  # fmt: skip
    upper.set_ylim(0, 1.02)
    upper.set_ylabel("share that is right")
    upper.legend(fontsize=8.5, frameon=False, loc="upper left")
    lower.bar(centre, found.count, wide, color=PALE_BLUE)
    lower.set_ylabel("clouds")
    lower.set_xlabel("confidence: the largest class probability")
    lower.set_xlim(0, 1)
    figure.suptitle(
        f"{run.title}: calibration on {run.target}\nexpected calibration error "
        f"{100 * found.error:.1f}% in {CALIBRATION_BINS} bins\n({EVALUATION_ONLY})",
        fontsize=11,
    )
    return figure


def embedding(
    title: str,
    places: dict[str, np.ndarray],
    labels: np.ndarray,
    domain: np.ndarray,
    names: Sequence[str],
    domains: Sequence[str],
) -> Figure:
    """Both domains' clouds on a plane: a panel for each of `places` (by its title, [n, 2]).

    Args:
        labels: [n] class; -1 unknown, drawn nearly black: one of the classes is grey.
        domain: [n] 0 source, 1 target.
        names, domains: of the classes and of the two domains.
    """
    from matplotlib import colormaps
    from matplotlib.lines import Line2D

    figure, axes = new_figure(5.3 * len(places) + 1.7, 5.9, 1, len(places))
    colours = colormaps["tab10" if len(names) <= 10 else "gist_ncar"]
    picked = [colours(k if len(names) <= 10 else 0.95 * k / len(names)) for k in range(len(names))]
    markers = ("o", "^")
    for ax, (heading, xy) in zip(axes, places.items(), strict=True):
        for d in (0, 1):
            for k in range(-1, len(names)):
                of = (domain == d) & (labels == k)
                colour = INK if k < 0 else picked[k]
                style: dict[str, Any] = {"facecolors": "none"} if d == 0 else {"facecolors": colour}
                ax.scatter(*xy[of].T, s=15, marker=markers[d], edgecolors=[colour],
                           linewidths=0.7, alpha=0.85, **style)  # fmt: skip
        ax.set(xticks=[], yticks=[])
        ax.set_title(heading, fontsize=10)
    handles = [
        Line2D([], [], linestyle="", marker=markers[d], markersize=6, color=INK,
               markerfacecolor="none" if d == 0 else INK, label=domains[d])
        for d in (0, 1)
    ]  # fmt: skip
    handles += [
        Line2D([], [], linestyle="", marker="s", color=colour, label=name)
        for name, colour in zip(names, picked, strict=True)
    ]
    if (labels < 0).any():
        handles.append(Line2D([], [], linestyle="", marker="s", color=INK, label="unknown class"))
    figure.legend(handles=handles, loc="outside right center", fontsize=8.5, frameon=False)
    figure.suptitle(title, fontsize=12)
    return figure


def _or(values: np.ndarray | None, otherwise: np.ndarray) -> np.ndarray:
    return otherwise if values is None else values


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)
