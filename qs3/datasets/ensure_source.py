"""`data.make_source=true`: a source that is not there is made, by its domain's own command."""

from __future__ import annotations

import logging
import os
import shlex
import subprocess

from qs3.config.location import python_command, typed
from qs3.datasets.domain import Domain, check_all
from qs3.errors import ConfigError, MissingDataError, Qs3Error

log = logging.getLogger(__name__)

_GENERATE = ["python", "generate.py"]


def check_or_make(source: Domain, target: Domain, make_source: bool) -> None:
    """Find out, in milliseconds, whether both domains are there; make the source if that is asked.

    Raises MissingDataError, which lists all that is missing, or as `make_if_missing`.
    """
    if make_source:
        target.check()  # before minutes are spent on the source
        make_if_missing(source)
    check_all(source, target)


def make_if_missing(domain: Domain) -> None:
    """Run `generate.py` for a domain whose data are not there; it shows its progress.

    An interrupted one goes on where it stopped when it is called again.

    Raises:
        ConfigError: the domain is published, not generated, so that nothing can make it.
        Qs3Error: the generation failed; its message is on the terminal.
    """
    try:
        domain.check()
    except MissingDataError:
        pass
    else:
        return
    words = shlex.split(domain.make or "")
    if words[:2] != _GENERATE:
        raise ConfigError(
            f"data.make_source=true, but domain {domain.name} is not generated; set it to false, "
            "and the message says where its files come from"
        )
    if int(os.environ.get("LOCAL_RANK", 0)) > 0:
        return  # the first process makes it
    log.info("%s is not there and is made: %s", domain.label, typed(shlex.join(words)))
    done = subprocess.run([*python_command("generate"), *words[2:]], check=False)
    if done.returncode:
        raise Qs3Error(
            f"domain {domain.name} could not be made (exit status {done.returncode}): see above; "
            "the same command goes on with it"
        )
