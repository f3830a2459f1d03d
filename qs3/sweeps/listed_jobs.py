"""A sweeper that runs the jobs of a file: how tables train what they lack."""

from __future__ import annotations

import json
from pathlib import Path

from hydra.core.utils import JobReturn

from qs3.errors import ConfigError, DataError
from qs3.sweeps.launching import OverLauncher


class ListedJobs(OverLauncher):
    """Runs the jobs in a JSON file: a list of lists of overrides. See `qs3.report.tables.running`.

    Args:
        file: of the jobs.
        at_once: so many are handed to the launcher, and waited for, before the next; None: all.
    """

    def __init__(self, file: str, at_once: int | None = None) -> None:
        self.file, self.at_once = Path(file), at_once

    def run(self, arguments: list[str]) -> list[JobReturn]:
        """Run them all, each with `arguments` as well; then raise the first error, if any."""
        try:
            listed: list[list[str]] = json.loads(self.file.read_text("utf-8"))
        except (OSError, ValueError) as error:
            raise DataError(f"the list of jobs {self.file} cannot be read ({error})") from error
        step = self.at_once or max(1, len(listed))
        if step < 1:
            raise ConfigError(f"hydra.sweeper.at_once must be at least 1, got {self.at_once}")
        done: list[JobReturn] = []
        for first in range(0, len(listed), step):
            jobs = [
                [*(word for word in arguments if word not in job), *job]
                for job in listed[first : first + step]
            ]
            done += self.launch(jobs, first)
        for job in done:
            _ = job.return_value  # raises if the job failed
        return done
