"""Fit the rules of `qs3.evaluation.trust` on the cases, and score them without each one's target.

    python .ci/trust_fit.py cases=docs/results/trust [out=qs3/evaluation/trust_weights.json]

The folder has the tables that `.ci/trust_cases.py` makes: cases.csv, adapted.csv of nets that were
adapted, which nothing is fitted on, and agreement.csv of both; estimates.csv is written there.
docs/results/trust.md has the rules, and what came out.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import spearmanr
from trust_cases import read

from qs3.evaluation.trust import LEAST_TRUSTED, expected, fit_weights
from qs3.evaluation.trust_file import Calibration, write_calibration
from qs3.utils.files import write_text

ALONE = ("unsure", "thresholded", "answers", "shapes", "outside", "counts")
"""Shifts that take nothing but the clouds and the net's answers."""

MORE = ("turns", "second", "seeds", "domain")
RULES = {"alone": ALONE, **{one: (*ALONE, one) for one in MORE}}
SHIPPED = "alone"
CONFIDENCES = {
    "calibrated confidence (AC)": "calibrated",
    "ATC": "thresholded_confidence",
    "DoC": "difference",
}
KINDS = {"narrow": "narrow PointNet", "pointnet": "PointNet", "dgcnn": "DGCNN"}
HEAD = ("", "cases", "mean error", "mean", "most too high", "refused", "right", "wrong", "rank")
CASE = ("net", "source", "seed", "target")

Row = dict[str, str]


class Fitted(NamedTuple):
    """What a rule expects of cases by weights that have not seen what they are left out by."""

    rows: list[Row]
    found: np.ndarray

    @property
    def truth(self) -> np.ndarray:
        """Accuracies."""
        return column(self.rows, "accuracy")

    def of(self, wanted: Callable[[Row], bool]) -> Fitted:
        """Some of them."""
        chosen = [i for i, row in enumerate(self.rows) if wanted(row)]
        return Fitted([self.rows[i] for i in chosen], self.found[chosen])


def target_of(row: Row) -> str:
    """The key of leave-one-target-out."""
    return row["left_out"]


def kind_of(row: Row) -> str:
    """Of a case's net."""
    (found,) = (kind for begins, kind in KINDS.items() if row["net"].startswith(begins))
    return found


def weights_of(names: Sequence[str], rows: list[Row]) -> dict[str, float]:
    """Fitted on these cases."""
    base, truth = column(rows, "held_out"), column(rows, "accuracy")
    return fit_weights(names, table(names, rows), base, truth, [target_of(row) for row in rows])


def left_out(
    names: Sequence[str],
    rows: list[Row],
    asked: list[Row] | None = None,
    keys: Sequence[Callable[[Row], str]] = (target_of,),
) -> Fitted:
    """Of each case that is asked, by the weights of `rows` that share none of its keys.

    A case for which nothing is left to fit is left out.
    """
    kept, found, known = [], [], {}
    for row in rows if asked is None else asked:
        of = tuple(key(row) for key in keys)
        if of not in known:
            rest = [
                one for one in rows if all(key(one) != x for key, x in zip(keys, of, strict=True))
            ]
            known[of] = weights_of(names, rest) if rest else None
        if (weights := known[of]) is not None:
            kept.append(row)
            shifts = {name: float(row[name]) for name in names}
            found.append(expected(float(row["held_out"]), shifts, weights))
    return Fitted(kept, np.array(found))


def by(fitted: Fitted, key: Callable[[Row], str]) -> list[list[str]]:
    """Lines of a table, one for each value of the key."""
    values = dict.fromkeys(key(row) for row in fitted.rows)
    return [score(value, fitted.of(lambda row, v=value: key(row) == v)) for value in values]


def score(name: str, fitted: Fitted) -> list[str]:
    """The cells of `HEAD`: errors in points, of all cases / of those that are not refused."""
    found, truth = fitted.found, fitted.truth
    off, kept = 100 * (found - truth), found >= LEAST_TRUSTED
    one = [f"{np.abs(x).mean():.1f}" if len(x) else "-" for x in (off, off[kept])]
    high = [f"{x.max():+.1f}" if len(x) else "-" for x in (off, off[kept])]
    rank = spearmanr(found, truth).statistic if len(found) > 2 and np.ptp(found) > 0 else np.nan
    refused = (~kept, ~kept & (truth < 0.5), ~kept & (truth > 0.7))
    return [
        *(name, str(len(found)), " / ".join(one), f"{off.mean():+.1f}", " / ".join(high)),
        *(str(int(which.sum())) for which in refused),
        f"{rank:.2f}",
    ]


def show(title: str, lines: list[list[str]]) -> None:
    """A table in Markdown."""
    every = [[*HEAD], ["---"] * len(HEAD), *lines]
    print(f"\n{title}\n", *(f"| {' | '.join(line)} |" for line in every), sep="\n")


def column(rows: list[Row], key: str) -> np.ndarray:
    """Of the table, as numbers."""
    return np.array([float(row[key]) for row in rows])


def table(names: Sequence[str], rows: list[Row]) -> np.ndarray:
    """[n, k] of the named columns."""
    return np.stack([column(rows, name) for name in names], axis=1)


def cases_in(folder: Path) -> tuple[list[Row], list[Row]]:
    """The cases, and those of adapted nets, with the shifts of agreement; "" of what is unknown."""
    more = {tuple(row[key] for key in CASE): row for row in read(folder / "agreement.csv")}

    def whole(name: str) -> list[Row]:
        nothing = {"second": "", "seeds": ""}
        return [
            {**row, **more.get(tuple(row[key] for key in CASE), nothing)}
            for row in read(folder / name)
        ]

    return whole("cases.csv"), whole("adapted.csv")


def main(given: dict[str, str]) -> None:
    """Show what each rule is worth, and write the estimates and, if asked, the weights."""
    folder = Path(given["cases"])
    rows, adapted = cases_in(folder)
    names = RULES[SHIPPED]
    shipped, weights = left_out(names, rows), weights_of(names, rows)
    print(f"weights of {SHIPPED}:", {name: round(value, 3) for name, value in weights.items()})
    lines = [score(name, Fitted(rows, column(rows, key))) for name, key in CONFIDENCES.items()]
    for rule, asks in RULES.items():
        some = [row for row in rows if all(row[name] for name in asks)]
        if len({target_of(row) for row in some}) > 1:
            lines.append(score(f"rule {rule}", left_out(asks, some)))
            if len(some) < len(rows):
                lines.append(score("rule alone, the same cases", left_out(ALONE, some)))
    show("Rules:", lines)
    show("By target:", by(shipped, lambda row: row["target"]))
    show("Real, by net and source:", by(shipped.of(lambda row: target_of(row) == "real"),
                                        lambda row: f"{row['net']}, {row['source']}"))  # fmt: skip
    show("By kind of net:", by(shipped, kind_of))
    for keys, words in (((kind_of,), "kind"), ((target_of, kind_of), "target nor kind")):
        show(f"By weights that saw no such {words}:", by(left_out(names, rows, keys=keys), kind_of))
    if adapted:
        show("Adapted:", by(left_out(names, rows, adapted), lambda row: row["target"]))
    write_text(folder / "estimates.csv", estimates_of(left_out(names, rows, rows + adapted)))
    if "out" in given:
        write_calibration(Path(given["out"]), calibration(shipped, weights))


def estimates_of(fitted: Fitted) -> str:
    """As CSV."""
    lines = [["net", "source", "seed", "target", "clouds", "accuracy", "expected"]]
    for row, value in zip(fitted.rows, fitted.found.tolist(), strict=True):
        lines.append([*(row[key] for key in (*CASE, "clouds", "accuracy")), f"{value:.4f}"])
    return "".join(f"{','.join(line)}\n" for line in lines)


def calibration(fitted: Fitted, weights: dict[str, float]) -> Calibration:
    """For `trust_weights.json`."""
    off = fitted.found - fitted.truth
    return Calibration(
        weights={name: round(value, 4) for name, value in weights.items() if value > 0},
        cases=len(off),
        targets=len({target_of(row) for row in fitted.rows}),
        mean_error=round(float(np.abs(off).mean()), 4),
        error_90=round(float(np.quantile(np.abs(off), 0.9)), 4),
        most_too_high=round(float(off.max()), 4),
    )


if __name__ == "__main__":
    main(dict(word.split("=", 1) for word in sys.argv[1:]))
