"""The fuzzing finds what is there to be found, of each kind, and follows the code's branches."""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import zipfile

import numpy as np
import pytest

from qs3.errors import DataError
from qs3.utils.allocator import keep_freed_memory
from tests.fuzzing import engine, mutate
from tests.fuzzing.coverage import Coverage
from tests.fuzzing.engine import Reader, fuzz

_HEAVY = ("TAR_GZ", "MODEL_FOLDER")  # to import

SEED = json.dumps({"n": 3, "a": 1, "b": 2, "c": 3}).encode()


def value_of(path):
    try:
        return json.loads(path.read_bytes())["n"]
    except Exception as error:
        raise DataError("damaged") from error


def spins(path):
    while isinstance(value_of(path), str):
        pass


def takes_memory(path):
    if isinstance(value := value_of(path), int) and value > 100:
        np.ones(20_000_000)


def dies(path):
    if value_of(path) is None:
        os.kill(os.getpid(), signal.SIGKILL)


def escapes(path):
    if value_of(path) == []:
        raise IndexError("nothing there")


@pytest.mark.parametrize(
    ("read", "kind"),
    [
        pytest.param(spins, "hang", marks=pytest.mark.slow),
        *((takes_memory, "memory"), (dies, "crash"), (escapes, "foreign")),
    ],
)
def test_what_a_reader_does_wrong_is_found(monkeypatch, read, kind):
    monkeypatch.setattr(engine, "MOST_CPU_S", 0.4)
    monkeypatch.setenv("QS3_MEMORY_GB", "0.05")
    reader = Reader("planted", lambda folder: [SEED], read, "a.json")
    for seed in range(20):  # of short runs: it is found soon, but not in any second
        outcome = fuzz(reader, 0.5, seed)
        if outcome.found:
            break
    assert {one.kind for one in outcome.found} == {kind}, outcome
    found = json.loads(bytes.fromhex(outcome.found[0].data))["n"]
    assert {"hang": str, "crash": type(None), "foreign": list, "memory": int}[kind] is type(found)


def after_a_training(folder):
    """What glibc keeps since is enough for all that `takes_memory` takes."""
    assert keep_freed_memory()
    np.ones(40_000_000)
    return [SEED]


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's")
def test_memory_that_was_freed_before_counts(monkeypatch):
    monkeypatch.setenv("QS3_MEMORY_GB", "0.05")
    reader = Reader("planted", after_a_training, takes_memory, "a.json")
    outcomes = (fuzz(reader, 0.5, seed) for seed in range(20))
    found = next((outcome.found for outcome in outcomes if outcome.found), [])
    assert [one.kind for one in found] == ["memory"]


def test_a_reader_without_a_fault_has_none():
    reader = Reader("planted", lambda folder: [SEED], value_of, "a.json")
    outcome = fuzz(reader, 0.5)
    assert outcome.found == []
    assert 0 < outcome.accepted < outcome.executions


def steps(tree):
    """Three branches, one within the other."""
    if tree.get("a") is None:
        if tree.get("b") is None:
            if tree.get("c") is None:
                return 3
            return 2
        return 1
    return 0


def deepest(guided, seed, tries):
    """How far a search with so many inputs comes."""
    rng, coverage, corpus, best = random.Random(seed), Coverage(("test_engine",)), [SEED], 0
    for _ in range(tries):
        data = mutate.mutated(rng.choice(corpus), corpus, None, rng)
        before = len(coverage.seen)
        try:
            tree = json.loads(data)
        except ValueError:
            continue
        if isinstance(tree, dict):
            with coverage.tracing():
                best = max(best, steps(tree))
            if guided and len(coverage.seen) > before:
                corpus.append(data)
    return best


def test_inputs_that_reach_new_lines_are_taken_further():
    guided = [deepest(True, seed, 400) for seed in range(3)]
    blind = [deepest(False, seed, 400) for seed in range(3)]
    assert sum(guided) > sum(blind)
    assert guided.count(3) >= 2


def test_parts_are_damaged_within_an_archive_that_stays_whole():
    rng = random.Random(0)
    seed = mutate.zipped([("a.txt", b"1 2 3 4 5\n"), ("b.json", SEED)])
    whole = changed = 0
    for _ in range(200):
        data = mutate.mutated(seed, [seed], mutate.ZIP, rng)
        try:
            parts = mutate.ZIP.open(data)
        except Exception:
            continue
        whole += 1
        changed += parts != mutate.ZIP.open(seed)
    assert whole > 120
    assert changed > 80


@pytest.mark.parametrize(
    "name",
    ["PNG", "GLB", "PACKED", *(pytest.param(x, marks=pytest.mark.slow) for x in _HEAVY)],
)
def test_what_is_taken_apart_is_put_together_again(name, tmp_path):
    from tests.fuzzing.readers import READERS

    shape = getattr(mutate, name)
    (reader, *_) = [one for one in READERS if one.shape is shape]
    for data in reader.seeds(tmp_path):
        parts = shape.open(data)
        again = shape.close(parts)
        assert shape.open(again) == parts
        (tmp_path / reader.file).write_bytes(again)
        if name != "PNG":  # one of them is no depth image
            reader.read(tmp_path / reader.file)


def test_the_archives_that_are_made_are_archives():
    made = mutate.zipped([("x", b"y")], zipfile.ZIP_DEFLATED)
    assert mutate.PACKED.open(made) == [("x", b"y")]
