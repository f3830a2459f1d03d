"""A row of a table is a combination of configs: it differs from its neighbour in what it names.

What each row's name says is written down here, as overrides of `train.py` on the bare task. A
cell's own command line, through whatever experiment file, must compose to the same config.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from typing import Any

import pytest
import yaml
from omegaconf import OmegaConf

from qs3.config.compose import composing
from qs3.config.location import CONF

SOURCES = {
    "M → D": "modelnet10",
    "S → D": "specklenet10",
    "S_c → D": "specklenet10_clean",
    "B → D": "blensor10",
    "M_d → D": "modelnet10_dropout",
}
LABELLED = ("domain@data.source=depthscannet10", "method=supervised")  # for whatever source
POINTDAN = (
    *("model=pointdan", "method=pointdan", "protocol.batch_size=64"),
    *("protocol.optimizer.lr=1.0e-4", "protocol.optimizer.weight_decay=5.0e-4"),
)
RELEASED = ("selftraining.selector.order=ascending", "selftraining.init=persistent")
PCM = ("method=pcm",)
QBST = (*PCM, "selftraining=qbst")


def _simpleview(epochs: int, batch_size: int = 32) -> tuple[str, ...]:
    """The protocol with what its authors chose for a net other than DGCNN."""
    return (
        "protocol=simpleview",
        f"protocol.epochs={epochs}",
        f"protocol.batch_size={batch_size}",
        "protocol.optimizer.weight_decay=0",
    )


NETS = {
    "PointNet++": ("model=pointnet2",),
    "DGCNN": (),
    "RSCNN": ("model=rscnn",),
    "SimpleView": ("model=simpleview",),
    "PointNet++, protocol = simpleview": ("model=pointnet2", *_simpleview(975)),
    "DGCNN, protocol = simpleview": ("model.variant=simpleview", "protocol=simpleview"),
    "RSCNN, protocol = simpleview": ("model=rscnn", *_simpleview(300)),
    "SimpleView, protocol = simpleview": ("model=simpleview", *_simpleview(650, 18)),
}
ROWS: Mapping[str, Mapping[str, Sequence[str]]] = {
    "noise": NETS,
    "ablation": NETS,
    "uda": {
        "Supervised": LABELLED,
        "DGCNN (w/o adapt)": (),
        "DGCNN (w/o adapt), norm = instance": ("model.norm=instance",),
        "DGCNN (w/o adapt), AdaBN": ("evaluation.norms=adabn",),
        "DANN": ("method=dann",),
        "PointDAN": POINTDAN,
        "DefRec": ("method=defrec",),
        "DefRec+PCM": ("method=defrec_pcm",),
        "GAST w/o SPST": ("method=gast",),
        "GAST": ("method=gast", "selftraining=spst"),
        "PCM": PCM,
        "PCM + QBST (from S it is QS3)": QBST,
    },
    "self_training": {
        "Supervised": LABELLED,
        "DGCNN (w/o adapt)": (),
        "DGCNN + CBST": ("selftraining=cbst",),
        "DGCNN + SPST": ("selftraining=spst",),
        "DGCNN + QBST": ("selftraining=qbst",),
        "DGCNN + PCM": PCM,
        "DGCNN + PCM + CBST": (*PCM, "selftraining=cbst"),
        "DGCNN + PCM + CRST (MRKLD)": (*PCM, "selftraining=crst_mrkld"),
        "DGCNN + PCM + CRST (LRENT)": (*PCM, "selftraining=crst_lrent"),
        "DGCNN + PCM + SPST": (*PCM, "selftraining=spst"),
        "DGCNN + PCM + QBST": QBST,
        "DGCNN + PCM + QBST, mu = 1": (*PCM, "selftraining=confident"),
        "DGCNN + PCM + QBST, random choice of its size": (*PCM, "selftraining=random"),
        "DGCNN + PCM + QBST, counts = all": (*QBST, "selftraining.selector.counts=all"),
        "DGCNN + PCM + QBST, order = ascending, init = persistent (released code)": (
            *QBST,
            *RELEASED,
        ),
    },
}


def _flat(node: Any, prefix: str = "") -> dict[str, Any]:
    """Dotted keys and their values; what every experiment may call itself is left out."""
    if isinstance(node, Mapping) and node:
        found: dict[str, Any] = {}
        for key, value in node.items():
            found |= _flat(value, f"{prefix}.{key}" if prefix else str(key))
        found.pop("experiment_name", None)
        return found
    return {prefix: node}


def differing(one: Mapping[str, Any], other: Mapping[str, Any]) -> set[str]:
    """Keys that only one config has, or that have different values."""
    both = one.keys() & other.keys()
    return (one.keys() ^ other.keys()) | {key for key in both if one[key] != other[key]}


def _place(override: str) -> str:
    """What an override may change: "method=pcm" the group, "model.norm=x" that key alone."""
    return override.split("=")[0].rpartition("@")[2]


def _within(key: str, places: set[str]) -> bool:
    return any(key == place or key.startswith(f"{place}.") for place in places)


@pytest.fixture(
    scope="module",
    params=[("uda", "self_training"), pytest.param(("noise", "ablation"), marks=pytest.mark.slow)],
    ids=" ".join,
)
def configs(request) -> dict[tuple[str, str, str], dict[str, Any]]:
    """What the command of each (table, column, row) composes to."""
    found = {}
    for table in request.param:
        spec = yaml.safe_load((CONF / "table" / f"{table}.yaml").read_text(encoding="utf-8"))
        assert [row["name"] for row in spec["rows"]] == list(ROWS[table])
        for row in spec["rows"]:
            for column in spec["columns"]:
                found[table, column, row["name"]] = row[column]["run"].split()
    return dict(zip(found, _compose(found.values()), strict=True))


def _compose(lines: Iterable[Sequence[str]]) -> list[dict[str, Any]]:
    with composing() as compose:
        return [_flat(OmegaConf.to_container(compose("train", list(line)))) for line in lines]


def _by_name(source: str, named: Sequence[str]) -> list[str]:
    """Overrides for a row of that name; the supervised one brings a source of its own."""
    task = (f"domain@data.source={source}", "domain@data.target=depthscannet10")
    taken = {_place(override) for override in named}
    return [override for override in task if _place(override) not in taken] + list(named)


def test_every_row_is_what_its_name_says(configs):
    """From S, and the plain net from all sources; for the rest see the test of columns."""
    plain = ("DGCNN", "DGCNN (w/o adapt)")
    rows = [where for where in configs if where[1] == "S → D" or where[2] in plain]
    names = _compose(_by_name(SOURCES[column], ROWS[table][row]) for table, column, row in rows)
    for where, name in zip(rows, names, strict=True):
        assert differing(configs[where], name) == set(), where


def test_rows_differ_in_nothing_but_what_they_name(configs):
    """Pairwise, of one column: only within the groups or keys that one of the two names."""
    for (table, column, one), (other_table, other_column, other) in combinations(configs, 2):
        if (table, column) != (other_table, other_column):
            continue
        named = {_place(override) for row in (one, other) for override in ROWS[table][row]}
        found = differing(configs[table, column, one], configs[table, column, other])
        assert found, f"{table}, {column}: {one} and {other} are the same run"
        outside = {key for key in found if not _within(key, named)}
        assert outside == set(), f"{table}, {column}: {one} and {other}"


def test_columns_differ_in_their_source_alone(configs):
    for (table, column, row), config in configs.items():
        for other in (c for t, c, r in configs if (t, r) == (table, row) and c != column):
            found = differing(config, configs[table, other, row])
            outside = {key for key in found if not _within(key, {"data.source"})}
            assert outside == set(), f"{table}, {row}: {column} and {other}"
