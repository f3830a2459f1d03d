"""Tasks in several processes; one that kills its process costs only itself.

Each worker has its own pipe and one task at a time: a process that is killed in the middle of a
message spoils no other one, and which task it had is known.
"""

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from types import ModuleType
from typing import Any, Generic, Protocol, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")

_HELD_BACK = (signal.SIGINT, signal.SIGTERM)
_STOP_S = 10.0  # how long a worker may take to end before it is killed


@dataclass(frozen=True, eq=False)
class Outcome(Generic[Result]):
    """What became of a task; `died`: its process ended each time before it was done."""

    name: str
    result: Result | None
    died: bool = False


Maker = Callable[[], Callable[[Task], Result]]
Tasks = Iterable[tuple[str, Task]]
Outcomes = Iterator[Outcome[Result]]


class Pool(Protocol):
    """Whoever does named tasks: processes of this machine, or `qs3.cluster`."""

    @property
    def at_once(self) -> int:
        """How many tasks are done at the same time, about; 0: here, one after the other."""

    @property
    def shared_disk(self) -> bool:
        """Whether workers see the files of this process under the same paths."""

    @property
    def elsewhere(self) -> bool:
        """Whether workers may be on machines with other software."""

    def run(self, make_worker: Maker[Task, Result], tasks: Tasks[Task]) -> Outcomes[Result]:
        """Do the tasks; see `Processes.run`."""


@dataclass(frozen=True)
class Processes:
    """Does named tasks in processes of this machine, and gives each outcome as soon as it is there.

    They are spawned, because neither Blender nor threads survive a fork; they leave Ctrl-C to
    their parent, and end with it however it ends. A task whose process dies is tried once more,
    in a new process while no other one works.

    Attributes:
        workers: how many at once; 0 does the tasks here, one after the other.
        tasks_per_process: after so many a process is replaced (where memory creeps).
    """

    workers: int
    tasks_per_process: int | None = None
    shared_disk: bool = field(default=True, init=False)
    elsewhere: bool = field(default=False, init=False)

    @property
    def at_once(self) -> int:
        """As many as there are workers."""
        return self.workers

    def run(self, make_worker: Maker[Task, Result], tasks: Tasks[Task]) -> Outcomes[Result]:
        """Do the tasks; yields one outcome a task, in the order in which they are done.

        What a worker raises ends everything; failures that must not are results.

        Args:
            make_worker: called once in each process; what it returns is called with each task.
                It, the tasks and the results are picklable.
            tasks: names and tasks; taken one by one, when a worker is free.
        """
        if self.workers:
            yield from self._run(make_worker, tasks)
            return
        work = make_worker()
        for name, task in tasks:
            yield Outcome(name, work(task))

    def _run(self, make_worker: Maker[Task, Result], tasks: Tasks[Task]) -> Outcomes[Result]:
        waiting = iter(tasks)
        crew: list[_Worker] = []
        suspects: list[tuple[str, Any]] = []
        outcomes: list[Outcome[Result]] = []
        try:
            while True:
                # There is no new work while one is to be tried again alone.
                while not suspects:
                    free = next((worker for worker in crew if worker.task is None), None)
                    if free is None and len(crew) >= self.workers:
                        break
                    if (task := next(waiting, None)) is None:
                        break
                    if free is None:
                        crew.append(free := _Worker(make_worker))
                    free.give(*task)
                # After they have new work: whoever takes the outcomes may be slow.
                yield from outcomes
                outcomes.clear()
                busy = {worker.pipe: worker for worker in crew if worker.task is not None}
                for pipe in wait(list(busy)) if busy else ():
                    worker = busy[pipe]  # type: ignore[index]
                    if (outcome := worker.receive()) is not None:
                        outcomes.append(outcome)
                    elif worker.task is not None:
                        suspects.append(worker.task)
                    if outcome is None or worker.done == self.tasks_per_process:
                        crew.remove(worker)
                        worker.stop()
                if busy:
                    continue
                if not suspects:
                    return
                while crew:
                    crew.pop().stop()
                for name, again in suspects:
                    crew.append(_Worker(make_worker))
                    crew[0].give(name, again)
                    yield crew[0].receive() or Outcome(name, None, died=True)
                    crew.pop().stop()
                suspects.clear()
        finally:
            for worker in crew:
                worker.stop()


class _Worker:
    """The parent's side of a process."""

    def __init__(self, make_worker: Callable[[], Callable[[Any], Any]]) -> None:
        context = get_context("spawn")
        self.task: tuple[str, Any] | None = None
        self.done = 0
        self.pipe, theirs = context.Pipe()
        self._process = context.Process(target=_work, args=(theirs, make_worker), daemon=True)
        try:
            with _held_back(), _a_method_that_it_knows(), _no_script(make_worker):
                self._process.start()
        except BaseException:
            self.pipe.close()
            raise
        finally:
            theirs.close()

    def give(self, name: str, task: Any) -> None:
        self.task = (name, task)
        message = pickle.dumps(task)
        with suppress(OSError):  # it is dead, which `receive` will find
            self.pipe.send_bytes(message)

    def receive(self) -> Outcome[Any] | None:
        """The outcome of its task, waiting for it; None if the process died."""
        assert self.task is not None
        try:
            message = self.pipe.recv_bytes()
        except (EOFError, OSError):
            return None
        good, value = pickle.loads(message)  # from a process of our own
        if not good:
            raise value
        name, self.task = self.task[0], None
        self.done += 1
        return Outcome(name, value)

    def stop(self) -> None:
        self.pipe.close()
        self._process.terminate()
        self._process.join(_STOP_S)
        self._process.kill()
        self._process.join()


@contextmanager
def _held_back() -> Iterator[None]:
    """Hold back Ctrl-C and SIGTERM in what is started here, until it takes them as `_work` says."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _HELD_BACK)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _a_method_that_it_knows() -> Iterator[None]:
    """A new process takes over the default start method, and would end at one of joblib's own."""
    method = multiprocessing.get_start_method(allow_none=True)
    if method is None or method in multiprocessing.get_all_start_methods():
        yield
        return
    multiprocessing.set_start_method("spawn", force=True)
    try:
        yield
    finally:
        multiprocessing.set_start_method(method, force=True)


@contextmanager
def _no_script(make_worker: Callable[[], Any]) -> Iterator[None]:
    """Start a process that does not run the script again, unless its work is defined there."""
    if b"__main__" in pickle.dumps(make_worker):
        yield
        return
    script = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script


def _work(pipe: Connection, make_worker: Callable[[], Callable[[Any], Any]]) -> None:
    """The process: answers each task with (True, result) or (False, error)."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what Ctrl-C means
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _HELD_BACK)
    threading.Thread(target=_die_with_parent, daemon=True).start()
    work = None
    while True:
        try:
            message = pipe.recv_bytes()
        except (EOFError, OSError):
            return
        try:
            work = work or make_worker()
            answer = pickle.dumps((True, work(pickle.loads(message))))
        except Exception as error:
            answer = pickle.dumps((False, portable(error)))
        pipe.send_bytes(answer)


def _die_with_parent() -> None:
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def portable(error: Exception) -> Exception:
    """A worker's error for its parent, with where it was raised; if it can be pickled."""
    where = "".join(traceback.format_exception(error))
    try:
        error.add_note(f"in a worker process:\n{where}")
        copy: Exception = pickle.loads(pickle.dumps(error))
    except Exception:
        copy = RuntimeError(f"{type(error).__name__}: {error}\n{where}")
    return copy
