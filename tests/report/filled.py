"""Tables with made-up runs."""

from dataclasses import replace

import numpy as np

from qs3.report.table import build_table, composed_of
from qs3.runs.predictions import FILE, Predictions, write_predictions
from tests.report.made_runs import write_run

PLACE = "target test"


def run_cell(log_dir, cell, seeds=(0, 1, 2), **changes):
    """Leave results for a cell, as if its command had been run; returns the runs' folders."""
    (experiment, hash_), _ = composed_of(cell)
    return [
        write_run(
            log_dir,
            experiment=experiment,
            hash=hash_,
            seed=seed,
            **{"accuracy": 0.5 + seed / 100, **changes},
        )
        for seed in seeds
    ]


def predictions(right, **changes):
    """Of 20 clouds of class 0, of which the first so many are called that."""
    names = tuple(map(str, range(20)))
    called = np.eye(2)[(np.arange(20) >= right).astype(int)]
    plain = Predictions(("a", "b"), names, names, np.zeros(20, dtype=int), called)
    return replace(plain, **changes)


def fill(log_dir, name, right_of, seeds=(0, 1, 2), changes=None, **of_clouds):
    """A table whose runs are right about so many of 20 clouds, the same for all seeds.

    Args:
        right_of: by row, or by row and column.
        changes: of each run's metrics.
        of_clouds: changes of the predictions.
    """
    for cell in build_table(name, log_dir).cells:
        for place in (cell.row, (cell.row, cell.column)):
            if place in right_of:
                for folder in run_cell(log_dir, cell, seeds, **(changes or {})):
                    write_predictions(folder / FILE, predictions(right_of[place], **of_clouds))
    return build_table(name, log_dir)
