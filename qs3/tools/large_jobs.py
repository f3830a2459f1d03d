"""What a large generation will take, from a small one: `qs3 plan data=FOLDER objects=100000`.

Time, memory and disk of each object come from a dataset that was made with the settings in
question, the course over many nodes from a simulation (`qs3.cluster.simulation`).
"""

from __future__ import annotations

import csv
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.utils.cli import NUMBER, Command, Option, one_of, path, several, whole
from qs3.utils.plural import counted
from qs3.utils.text_table import three_digits

if TYPE_CHECKING:
    import numpy as np

    from qs3.cluster.simulation import Course, Nodes

ENGINES = ("local", "ray", "slurm")
_FEW = 30  # objects; of fewer the long ones may be missing
_MOST = 10_000_000  # objects: a simulation has each of them in memory
_PART_BYTES = 3000  # an object's file beside its arrays: names, a note, a zip's list
_HEADER = ("id", "seconds", "peak_memory_mb")


@dataclass(frozen=True, eq=False)
class Measured:
    """What a small dataset says of each object.

    Attributes:
        seconds: [n] float64, of one process.
        memory_mb: [n] float64, the most that its process had taken by then.
        stored_bytes: of a cloud in the finished dataset, with twin and tables.
        view_bytes: of its kept views; 0 where there are none.
    """

    seconds: np.ndarray
    memory_mb: np.ndarray
    stored_bytes: float
    view_bytes: float


def measured(folder: Path) -> Measured:
    """Read costs.csv and the description of a dataset that generate.py made.

    Raises:
        MissingDataError: it is not there, or was not finished.
        DataError: a file is damaged.
    """
    import numpy as np

    from qs3.data.dataset_folder import COSTS, VIEWS
    from qs3.data.meta import meta_of_finished
    from qs3.utils.memory import TABLE_PEAK, read_whole

    meta = meta_of_finished(folder)
    place = folder / COSTS
    if not place.is_file():
        raise MissingDataError(f"{folder} has no {COSTS}: it was not made by generate.py")
    try:
        header, *rows = csv.reader(read_whole(place, TABLE_PEAK).decode().splitlines())
        costs = np.array([[float(row[1]), float(row[2])] for row in rows], dtype=np.float64)
        good = tuple(header) == _HEADER and len(costs) and np.isfinite(costs).all()
    except (OSError, UnicodeDecodeError, csv.Error, ValueError, IndexError) as error:
        raise DataError(f"{place} cannot be read ({error})") from error
    if not good or (costs < 0).any():
        raise DataError(f"{place} is not what generate.py writes: {', '.join(_HEADER)}")
    columns = {key: len(names) for key, names in (meta.get("tables") or {}).items()}
    arrays = set(meta["sha256"]) - {"manifest"}
    views = sum(file.stat().st_size for file in (folder / VIEWS).rglob("*") if file.is_file())
    return Measured(
        seconds=costs[:, 0],
        memory_mb=costs[:, 1],
        stored_bytes=sum(4 * meta["points"] * columns.get(key, 3) for key in arrays),
        view_bytes=views / meta["clouds"],
    )


@dataclass(frozen=True)
class Row:
    """A number of nodes, and what came of it in several simulations.

    Attributes:
        nodes: how many.
        hours, hours_95: median, and what 19 of 20 courses do not exceed.
        lost_share, idle_share: means, of the workers' time.
        failures: mean number, of nodes.
    """

    nodes: int
    hours: float
    hours_95: float
    lost_share: float
    idle_share: float
    failures: float


def simulated(courses: Sequence[Course], nodes: Nodes) -> Row:
    """A row of the table."""
    import numpy as np

    hours = np.array([course.hours for course in courses])
    of_all = hours * nodes.number * nodes.workers
    return Row(
        nodes=nodes.number,
        hours=float(np.median(hours)),
        hours_95=float(np.quantile(hours, 0.95)),
        lost_share=float(np.mean([c.lost_h for c in courses] / of_all)),
        idle_share=float(np.mean([c.idle_h for c in courses] / of_all)),
        failures=float(np.mean([course.failures for course in courses])),
    )


def _plan(
    data: Path,
    objects: int,
    nodes: Sequence[int],
    workers: int,
    engine: str,
    tasks_per_job: int,
    start_s: float,
    speed: float,
    life_h: float | None,
    repair_min: float,
    slow_share: float,
    slow_times: float,
    price: float | None,
    node_gb: float | None,
    trials: int,
    out: Path | None,
) -> None:
    import numpy as np

    from qs3.cluster.simulation import Nodes, simulate
    from qs3.utils import text_table
    from qs3.utils.files import write_text
    from qs3.utils.progress import shown

    if not speed > 0:
        raise ConfigError(f"speed must be above 0, got {speed:g}")
    if objects > _MOST:
        raise ConfigError(
            f"objects={objects}: at most {_MOST:,} are simulated, one by one; plan for that many, "
            "and take hours, disk and cost in proportion"
        )
    of = measured(data)
    rng = np.random.default_rng(0)
    courses = []
    kinds = [
        Nodes(number, workers, start_s, life_h, repair_min, slow_share, slow_times)
        for number in nodes
    ]
    for machines, trial in shown(list(itertools.product(kinds, range(trials))), "simulating"):
        course = simulate(
            rng.choice(of.seconds, objects) / speed,
            machines,
            tasks_per_job=tasks_per_job if engine == "slurm" else 1,
            start_each_job=engine == "slurm",
            seed=trial,
        )
        courses.append(course)
    rows = [
        simulated(courses[i * trials : (i + 1) * trials], machines)
        for i, machines in enumerate(kinds)
    ]
    for line in _about(of, objects, workers, speed, node_gb):
        print(line)
    header = ["nodes", "hours", "95 %", "node hours", "lost %", "idle %", "failures"]
    header += ["cost"] if price is not None else []
    table = [header, *(_words(row, price) for row in rows)]
    print("\n" + "\n".join(text_table.aligned(table, numbers=True)))
    print(
        f"\nhours: median and 95 % of {trials} simulated courses; lost: on objects and starts that "
        "a failure cut off;\nidle: at the end, when there is nothing left to do, and while a node "
        "is away."
    )
    if out is not None:
        write_text(out, text_table.csv_text(table))
        print(f"saved {out}")


def _about(
    of: Measured, objects: int, workers: int, speed: float, node_gb: float | None
) -> list[str]:
    """What was measured, and what follows from it without a simulation."""
    import numpy as np

    n, total = len(of.seconds), objects * of.seconds.mean() / speed
    gigabytes = objects * of.stored_bytes / 1e9
    # The description of a dataset begins only when it is whole: until then both are there.
    during = gigabytes + objects * (of.stored_bytes + _PART_BYTES) / 1e9
    needed = workers * np.quantile(of.memory_mb, 0.99) / 1e3
    views = objects * of.view_bytes / 1e9
    lines = [
        f"measured on {counted(n, 'object')}: {three_digits(np.median(of.seconds))} s in the "
        f"middle, {three_digits(of.seconds.mean())} on average, at most "
        f"{three_digits(of.seconds.max())}; "
        f"at most {of.memory_mb.max():.0f} MB a process",
        f"{objects:,} objects: {three_digits(total / 3600)} core-hours; {three_digits(gigabytes)} "
        f"GB when it is done, {three_digits(during)} GB on the way"
        + (f", and {three_digits(views)} GB of views" if views else ""),
        f"a node with {counted(workers, 'worker')}: {needed:.2g} GB of memory",
    ]
    if n < _FEW:
        lines.append(
            f"of {counted(n, 'object')} the longest may be missing: measure {_FEW} or more"
        )
    if node_gb is not None and needed > node_gb:
        fits = int(node_gb / needed * workers)
        lines.append(f"node_gb={node_gb:g} is not enough for them: workers={max(fits, 1)}")
    return lines


def _words(row: Row, price: float | None) -> list[str]:
    words = [
        str(row.nodes),
        three_digits(row.hours),
        three_digits(row.hours_95),
        three_digits(row.hours * row.nodes),
        f"{100 * row.lost_share:.1f}",
        f"{100 * row.idle_share:.1f}",
        f"{row.failures:.1f}",
    ]
    return words if price is None else [*words, f"{row.hours * row.nodes * price:.2f}"]


PLAN = Command(
    "qs3 plan",
    "what a large generation will take, from a small one",
    _plan,
    (
        Option("data", path("FOLDER"), "a dataset that was made with these settings", None, True),
        Option("objects", whole(), "how many are wanted", None, True),
        Option("nodes", several(whole()), "numbers of machines to compare", (1, 4, 16, 64)),
        Option("workers", whole(), "objects at once on each; cores, as a rule", 16),
        Option("engine", one_of(*ENGINES), "who hands them out", "ray"),
        Option("tasks_per_job", whole(), "of engine=slurm, as in generate.py", 100),
        Option("start_s", NUMBER, "seconds that a worker takes before its first object", 10.0),
        Option("speed", NUMBER, "speed of their cores, as a multiple of the measuring ones'", 1.0),
        Option("life_h", NUMBER, "mean hours until a node fails; none fails without it"),
        Option("repair_min", NUMBER, "minutes until it, or another, is back", 10.0),
        Option("slow_share", NUMBER, "share of nodes that are slow, 0 to 1", 0.0),
        Option("slow_times", NUMBER, "how many times as long everything takes there", 2.0),
        Option("price", NUMBER, "what a node costs an hour, in any currency"),
        Option("node_gb", NUMBER, "memory of a node in GB, to be compared with what is needed"),
        Option("trials", whole(), "simulated courses of each number of nodes", 20),
        Option("out", path("FILE"), "also as CSV"),
    ),
    (
        "qs3 plan data=trial/specklenet10 objects=100000",
        "qs3 plan data=trial/specklenet10 objects=100000 nodes=8 life_h=24 slow_share=0.1 price=2",
    ),
    about="The dataset: qs3-generate domain=specklenet10 meshes=PATH limit=5 "
    "paths.data_dir=trial\n\n"
    "Objects are drawn from the measured ones, so measure some of every kind. A node is paid "
    "for from the\nbeginning to the end. docs/how-to/cluster.md plans a job with it.",
)
