"""Reads the records of an offline wandb run: the installed version has no reader in Python."""

import json
import struct
import time
from pathlib import Path

_BLOCK = 32768  # LevelDB's log format, after a header of 7 bytes that counts as part of block 0
_FULL, _FIRST, _LAST = 1, 2, 4


def records(folder: Path):
    """Records of the one offline run under a run's folder, in order."""
    from wandb.proto import wandb_internal_pb2

    (path,) = folder.glob("wandb/offline-run-*/run-*.wandb")
    data, at, parts = path.read_bytes(), 7, b""
    assert data[:4] == b":W&B"
    while at + 7 <= len(data):
        room = _BLOCK - at % _BLOCK
        if room < 7:
            at += room
            continue
        _, length, kind = struct.unpack("<IHB", data[at : at + 7])
        piece = data[at + 7 : at + 7 + length]
        parts = piece if kind in (_FULL, _FIRST) else parts + piece
        at += 7 + length
        if at > len(data):  # half of a record that is being written
            return
        if kind in (_FULL, _LAST):
            record = wandb_internal_pb2.Record()
            record.ParseFromString(parts)
            yield record


def complete(folder: Path, seconds: float = 60.0):
    """All records, once the last is there: wandb's own process writes on after `finish`."""
    until = time.monotonic() + seconds
    while True:
        found = list(records(folder))
        if found and found[-1].WhichOneof("record_type") == "exit":
            return found
        assert time.monotonic() < until, "the offline run was not ended"
        time.sleep(0.1)


def read(folder: Path):
    """Config, history rows and summary of the run, as dicts of plain values, and its record."""
    config, rows, summary, run = {}, [], {}, None
    for record in complete(folder):
        kind = record.WhichOneof("record_type")
        if kind == "run":
            run = record.run
            config.update(_items(record.run.config.update))
        elif kind == "config":
            config.update(_items(record.config.update))
        elif kind == "history":
            rows.append(_items(record.history.item))
        elif kind == "summary":
            summary.update(_items(record.summary.update))
    return config, rows, summary, run


def _items(items):
    found = {}
    for item in items:
        *parents, last = [item.key] if item.key else item.nested_key
        node = found
        for name in parents:
            node = node.setdefault(name, {})
        node[last] = json.loads(item.value_json)
    return found
