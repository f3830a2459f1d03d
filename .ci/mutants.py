"""How strong the tests are: faults put into the code one at a time, and whether a test fails.

    python .ci/mutants.py .ci/mutants.toml TABLE.csv          # all that the file names
    python .ci/mutants.py .ci/mutants.toml TABLE.csv store    # only targets named so
    python .ci/mutants.py .ci/mutants.toml TABLE.csv again    # survivors, too: tests were added

The faults ("mutants") are those of cosmic-ray's operators: other comparisons, arithmetic, numbers
and booleans, `and` for `or`, a removed `not`, decorator or loop, other exceptions. Those in type
annotations change nothing and are left out. Each is judged by the tests named for its module
alone, and of these by those that execute its line (see `Tracer`), so a mutant that only a distant
test would notice counts as alive.

cosmic-ray's own runner starts Python and imports torch anew for every mutant. Here a worker has
the large libraries loaded, works on a copy of the tracked files, and forks a child for each
mutant. Results are appended as they come: a second call goes on where the first one stopped, and
those of a module that was changed since are taken out. Survivors that were read and change
nothing are listed under `equivalent`, with the reason; shares are printed with and without them.
"""

from __future__ import annotations

import ast
import csv
import gc
import hashlib
import importlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
import traceback
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

WORKERS = int(os.environ.get("WORKERS", "2"))
LIBRARIES = [
    *("numpy", "scipy.spatial", "torch", "torch.utils.data", "torch._dynamo", "lightning", "hydra"),
    *("omegaconf", "pydantic", "rich.progress", "h5py", "cv2", "pytest", "trimesh", "filelock"),
    *("matplotlib.pyplot", "torchmetrics", "fpsample", "hypothesis.strategies", "jaxtyping"),
]
OPTIONS = [
    *("-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist"),
    "--hypothesis-profile=mutants",
    *("-W", "ignore::pytest.PytestAssertRewriteWarning"),  # of plugins that are loaded already
]
ALIVE = "survived"
KEY = ("module", "version", "operator", "occurrence")
FIELDS = ["target", "module", "version", "operator", "occurrence", "line", "outcome", "change"]


@dataclass(frozen=True)
class Mutant:
    """One fault: the `occurrence`-th place of a module where an operator applies."""

    target: str
    module: str
    version: str  # of the module: how its SHA-256 begins
    operator: str
    occurrence: int
    line: int

    @property
    def key(self) -> tuple[str, ...]:
        """What tells it from the others."""
        return tuple(str(getattr(self, name)) for name in KEY)


def annotated_spans(source: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Where annotations stand: (line, column) of their beginnings and ends."""
    spans = []
    for node in ast.walk(ast.parse(source)):
        for note in (getattr(node, "annotation", None), getattr(node, "returns", None)):
            if isinstance(note, ast.expr):
                start = note.lineno, note.col_offset
                spans.append((start, (note.end_lineno or 0, note.end_col_offset or 0)))
    return spans


def mutants(root: Path, target: str, module: str) -> Iterator[Mutant]:
    """All mutants of a module, those in annotations left out."""
    source = (root / module).read_text()
    spans = annotated_spans(source)
    tree, version = get_ast(source), hashlib.sha256(source.encode()).hexdigest()[:12]
    for name in sorted(operator_names()):
        kind = get_operator(name)
        if kind.arguments():
            continue
        operator = kind()
        places = [place for node in ast_nodes(tree) for place in operator.mutation_positions(node)]
        for occurrence, (start, _) in enumerate(places):
            if not any(first <= tuple(start) < last for first, last in spans):
                yield Mutant(target, module, version, name, occurrence, start[0])


def chosen(root: Path, targets: dict[str, Any], names: list[str]) -> list[tuple[Mutant, list[str]]]:
    """The mutants to try, with the tests that judge each; a sample is drawn by its seed."""
    jobs: list[tuple[Mutant, list[str]]] = []
    for target, spec in targets.items():
        if names and target not in names:
            continue
        found: list[tuple[Mutant, list[str]]] = []
        for pattern, tests in spec["modules"].items():
            for path in sorted(root.glob(pattern)):
                module = str(path.relative_to(root))
                if module in spec.get("except", []) or path.name == "__init__.py":
                    continue
                first = f"tests/{path.parent.relative_to(root / 'qs3')}/test_{path.stem}.py"
                order = [test for test in tests if "*" not in test]
                order += [first] if (root / first).exists() else []
                for test in tests:
                    order += [str(p.relative_to(root)) for p in sorted(root.glob(test))]
                found += [(m, list(dict.fromkeys(order))) for m in mutants(root, target, module)]
        if "sample" in spec:
            found = random.Random(spec["seed"]).sample(found, min(spec["sample"], len(found)))
        jobs += found
    return jobs


class Tracer:
    """Which tests execute which lines: a plugin for the run of the tests without a fault.

    Lines of a test's set-up and tear-down are of all tests of its file, as its fixtures may be, and
    lines that run while modules are imported, in other processes or not at all are of every test.
    """

    def __init__(self, root: Path, modules: list[str], out: Path) -> None:
        self.files = {str(root / module): module for module in modules}
        self.out, self.now = out, ""
        self.seen: dict[str, dict[int, set[str]]] = {module: {} for module in modules}

    def _enter(self, frame: Any, event: str, argument: Any) -> Any:
        return self._line if frame.f_code.co_filename in self.files else None

    def _line(self, frame: Any, event: str, argument: Any) -> Any:
        lines = self.seen[self.files[frame.f_code.co_filename]]
        lines.setdefault(frame.f_lineno, set()).add(self.now)
        return self._line

    def pytest_sessionstart(self) -> None:
        """From before the modules are imported on."""
        threading.settrace(self._enter)
        sys.settrace(self._enter)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """A set-up comes."""
        self.now = nodeid.split("::")[0]

    def pytest_runtest_call(self, item: Any) -> None:
        """The test itself comes: of several plugins pytest asks the latest one first."""
        self.now = item.nodeid
        sys.settrace(self._enter)  # another test may have set another

    def pytest_runtest_teardown(self, item: Any) -> None:
        """A tear-down comes, and the next set-up."""
        self.now = item.nodeid.split("::")[0]

    def pytest_sessionfinish(self) -> None:
        """Write {module: {line: tests}}."""
        sys.settrace(None)
        plain = {m: {n: sorted(by) for n, by in lines.items()} for m, lines in self.seen.items()}
        self.out.write_text(json.dumps(plain))


def judges(tests: list[str], lines: dict[str, list[str]], source: str, line: int) -> list[str]:
    """Those of a module's tests that execute a line; all where none is known to.

    Args:
        tests: files, in the order in which they run.
        lines: of the module, by number: tests, files, or "" for what runs in no test.
        source: of the module.
        line: of the mutant. One without a trace of its own (of an expression over several lines)
            is taken for all of the innermost function around it.
    """
    found = set(lines.get(str(line), ()))
    if not found:
        around = [
            (node.lineno, node.end_lineno or 0)
            for node in ast.walk(ast.parse(source))
            if isinstance(node, ast.FunctionDef) and node.lineno < line <= (node.end_lineno or 0)
        ]
        if around:
            first, last = max(around)
            within = range(first + 1, last + 1)
            found = {test for n in within for test in lines.get(str(n), ())}
    if not found or "" in found:
        return tests
    whole = {name for name in found if "::" not in name}
    single = sorted(name for name in found if name.split("::")[0] not in whole)
    chosen = [*whole, *single]
    return sorted(chosen, key=lambda name: tests.index(name.split("::")[0]))


def run_tests(
    copy: Path, tests: list[str], limit: float, log: Path, *plugins: Any
) -> tuple[str, float]:
    """Fork, run the tests there, and say how it ended: killed, survived or timeout."""
    start = time.monotonic()
    child = os.fork()
    if child == 0:
        try:
            os.setsid()
            stream = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(stream, 1)
            os.dup2(stream, 2)
            os.chdir(copy)
            import pytest

            rc = pytest.main([*OPTIONS, *tests], plugins=list(plugins))
        except BaseException:
            traceback.print_exc()
            rc = 3
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(int(rc))
    while time.monotonic() - start < limit:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            code = os.waitstatus_to_exitcode(status)
            kill_group(child)
            return ALIVE if code == 0 else "killed", time.monotonic() - start
        time.sleep(0.02)
    kill_group(child)
    os.waitpid(child, 0)
    return "timeout", time.monotonic() - start


def kill_group(leader: int) -> None:
    """End what a child may have started."""
    with suppress(ProcessLookupError):
        os.killpg(leader, signal.SIGKILL)


def work(
    root: Path, number: int, modules: dict[frozenset[str], list[str]], jobs: Any, results: Any
) -> None:
    """A worker: its own copy of the files, the libraries loaded, a child for each mutant.

    `modules`: of each set of tests those that it judges.
    """
    copy = Path(tempfile.mkdtemp(prefix=f"mutants{number}-")) / "repo"
    files = subprocess.check_output(["git", "-C", str(root), "ls-files", "-z"], text=True)
    for name in filter(None, files.split("\0")):
        if (root / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(root / name, copy / name)
    packages = os.pathsep.join(filter(None, [str(copy), os.environ.get("PYTHONPATH")]))
    os.environ.update(
        PYTHONPATH=packages, OMP_NUM_THREADS="1", MPLBACKEND="Agg", TMPDIR=str(copy.parent)
    )
    tempfile.tempdir = str(copy.parent)
    sys.path.insert(0, str(copy))
    for name in LIBRARIES:
        importlib.import_module(name)
    from hypothesis import Phase, settings

    phases = (Phase.explicit, Phase.generate)  # a counterexample is enough, it need not be small
    settings.register_profile(
        "mutants", deadline=None, derandomize=True, database=None, phases=phases
    )
    gc.collect()
    gc.freeze()  # a collection in a child would touch, and so copy, all of it: twice the time
    limits: dict[frozenset[str], float] = {}
    traced: dict[frozenset[str], dict[str, dict[str, list[str]]]] = {}
    log, trace = copy.parent / "log.txt", copy.parent / "trace.json"
    while (job := jobs.get()) is not None:
        mutant, tests = job
        path = copy / mutant.module
        source = path.read_text()
        if (which := frozenset(tests)) not in limits:
            sys.dont_write_bytecode = False
            tracer = Tracer(copy, modules[which], trace)
            outcome, seconds = run_tests(copy, tests, 3600, log, tracer)
            if outcome != ALIVE:
                raise SystemExit(
                    f"The tests fail without a mutant: {tests}\n{log.read_text()[-3000:]}"
                )
            limits[which] = 3 * seconds + 15
            traced[which] = json.loads(trace.read_text())
        sys.dont_write_bytecode = True
        try:
            changed = mutate_code(source, get_operator(mutant.operator)(), mutant.occurrence)
        except AttributeError:  # cosmic-ray's for exceptions of a module: `except yaml.YAMLError`
            changed = None
        for cached in (path.parent / "__pycache__").glob(f"{path.stem}.*"):
            cached.unlink()
        if changed is None or changed == source:
            results.put((mutant, "none", ""))
            continue
        path.write_text(changed)
        try:
            judged_by = judges(tests, traced[which][mutant.module], source, mutant.line)
            outcome, _ = run_tests(copy, judged_by, limits[which], log)
        finally:
            path.write_text(source)
        before, after = source.splitlines(), changed.splitlines()
        same = next((i for i, (a, b) in enumerate(zip(before, after, strict=False)) if a != b), 0)
        line = f"{before[same].strip()}  ->  {after[same].strip() if same < len(after) else ''}"
        results.put((mutant, outcome, line))
        for left in copy.parent.glob("pytest-of-*"):
            shutil.rmtree(left, ignore_errors=True)
    shutil.rmtree(copy.parent, ignore_errors=True)


def summary(rows: list[dict[str, str]], equivalent: set[tuple[str, str]] = frozenset()) -> str:
    """A table: of each module how many mutants there were and what share died.

    `equivalent`: (module, change) of survivors that were read and found to change nothing; the last
    column leaves them out.
    """
    counts: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    for row in rows:
        same = row["outcome"] == ALIVE and (row["module"], row["change"]) in equivalent
        if row["outcome"] != "none":
            for key in ((row["target"], row["module"]), (row["target"], "together")):
                counts[key]["equivalent" if same else row["outcome"]] += 1
    head = ["target", "module", "mutants", "killed", "equivalent", "killed of the others"]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for (target, module), count in sorted(counts.items()):
        dead, same = count["killed"] + count["timeout"], count["equivalent"]
        shares = [
            f"{100 * dead / n:.1f} %" if n else "" for n in (count.total(), count.total() - same)
        ]
        cells = [target, module, str(count.total()), shares[0], str(same), shares[1]]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def still_true(
    there: list[dict[str, str]], mutants: list[Mutant], again: bool
) -> list[dict[str, str]]:
    """Earlier results, without those of changed modules (and of survivors, to try them again)."""
    targets = {mutant.target for mutant in mutants}
    versions = {(mutant.module, mutant.version) for mutant in mutants}
    return [
        row
        for row in there
        if row["target"] not in targets
        or ((row["module"], row["version"]) in versions and not (again and row["outcome"] == ALIVE))
    ]


def main(targets_file: str, out: str, *names: str) -> None:
    """Try what has not been tried yet, and print the table."""
    root = Path(os.environ.get("MUTANTS_ROOT", Path(__file__).parents[1])).resolve()
    targets = tomllib.loads(Path(targets_file).read_text())
    read = targets.pop("equivalent", [])
    same = {(entry["module"], change) for entry in read for change in entry["changes"]}
    jobs = chosen(root, targets, [name for name in names if name != "again"])
    table = Path(out)
    table.parent.mkdir(parents=True, exist_ok=True)
    there = list(csv.DictReader(table.open())) if table.exists() else []
    rows = still_true(there, [mutant for mutant, _ in jobs], again="again" in names)
    done = {tuple(row[name] for name in KEY) for row in rows}
    wanted = [job for job in jobs if job[0].key not in done]
    modules: dict[frozenset[str], list[str]] = defaultdict(list)
    for mutant, tests in jobs:
        if mutant.module not in modules[frozenset(tests)]:
            modules[frozenset(tests)].append(mutant.module)
    context = get_context("fork")
    queue, results = context.Queue(), context.Queue()
    for job in [*wanted, *[None] * WORKERS]:
        queue.put(job)
    workers = [
        context.Process(target=work, args=(root, number, dict(modules), queue, results))
        for number in range(WORKERS)
    ]
    for worker in workers:
        worker.start()
    with table.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, FIELDS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        for number in range(1, len(wanted) + 1):
            while results.empty():
                if any(worker.exitcode for worker in workers):
                    raise SystemExit("A worker failed; what it printed stands above.")
                time.sleep(0.05)
            mutant, outcome, change = results.get()
            rows.append({**asdict(mutant), "outcome": outcome, "change": change})
            writer.writerow(rows[-1])
            stream.flush()
            if number % 25 == 0:
                print(f"{number} of {len(wanted)}", file=sys.stderr, flush=True)
    print(summary(rows, same))


if __name__ == "__main__":
    if len(sys.argv) < 3:
        raise SystemExit(__doc__)
    main(*sys.argv[1:])
