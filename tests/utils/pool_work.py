"""What the pool's processes do in its tests; they import nothing else."""

import multiprocessing
import os
import signal
import time

from qs3.errors import DataError
from qs3.utils.pool import Processes


class Strange(Exception):
    """Cannot be made again from what a pickle keeps of it."""

    def __init__(self, a, b):
        super().__init__(f"{a} and {b}")


def work(task):
    what, value = task
    match what:
        case "square":
            return value * value
        case "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        case "kill once":
            if not value.exists():
                value.touch()
                os.kill(os.getpid(), signal.SIGKILL)
            return "survived"
        case "raise":
            raise value
        case "raise strange":
            raise Strange(1, 2)
        case "pid":
            return os.getpid()
        case "large":
            return bytes(value)


def make():
    return work


def die_at_once():
    os._exit(3)


def no_worker():
    raise DataError("no licence")


def sleep(seconds):
    time.sleep(seconds)


def make_sleepers():
    return sleep


def pids_in_a_job(tasks):
    """In a process of joblib's, as a run of a sweep is."""
    before = multiprocessing.get_start_method()
    found = list(Processes(2).run(make, tasks))
    return before, multiprocessing.get_start_method(), found
