"""Twins beside source clouds, second draws, and sensors drawn anew: which clouds, moved how."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import open_dict
from torch import Tensor

from qs3.config.hashing import config_sha256
from qs3.datamodules.adaptation import AdaptationData
from qs3.datamodules.augment import Augment
from qs3.datamodules.domain import DomainData
from qs3.datamodules.phases import Phases, SelfTrainingConfig
from qs3.datamodules.random_views import RandomViews, drawn
from qs3.datamodules.twins import Wants, augmented
from qs3.datasets.domain import Domain
from qs3.errors import ConfigError, DataError
from qs3.geometry.sampling import farthest_point_sampling_np, unit_ball
from qs3.store.store import ManifestRow, write_pointset
from tests.composing import compose

N, P, M = 20, 32, 16
STILL = Augment(rotate_z=False, jitter_sigma=0.0)


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A source whose arrays can be told by their x: cloud i of array k lies around 100 k + i."""
    root = tmp_path_factory.mktemp("stores")
    rng = np.random.default_rng(0)
    names = ("points", "points_clean", "points_whole", "points_exact")
    names += ("points_view0", "points_view0_exact", "points_view1", "points_view1_exact")
    arrays = {}
    for k, name in enumerate(names):
        clouds = rng.normal(size=(N, P, 3)).astype(np.float32)
        clouds[:, :, 0] = clouds[:, :, 0] / 100 + 100 * k + np.arange(N)[:, None]
        arrays[name] = clouds
    rows = [ManifestRow(f"c{i:02d}", "ab"[i % 2], "train") for i in range(N)]
    some = {"classes": ("a", "b"), "rows": rows, "meta": {}}
    write_pointset(root / "s", name="s", arrays=arrays, **some)
    write_pointset(root / "t", name="t", arrays={"points": arrays["points"]}, **some)
    return root


def domain(folder: Path, **more: Any) -> Domain:
    more = {"unit": "metres", "floor_m": 0.0, **more}
    return Domain(folder.name, "S", "S", folder, classes=("a", "b"), **more)


def adaptation(
    stores: Path, wants: Wants, augment: Augment = STILL, views: str = "stored", **more: Any
) -> AdaptationData:
    scheme = SelfTrainingConfig(
        rounds=0, epochs=1, batch_size=4, theta=0.5, epsilon=0.0, selector=None
    )
    more = {"points": M, "scale": "metres", "batch_size": 4, "seed": 3, **more}
    data = AdaptationData(
        domain(stores / "s", views=views), domain(stores / "t"),
        phases=Phases(3, scheme), scheme=scheme, augment=augment, uses_target=True,
        wants=wants, **more,
    )  # fmt: skip
    data.prepare_data()
    data.setup()
    return data


def augmented_batches(data: AdaptationData) -> list[dict[str, Any]]:
    """As a trainer hands them on."""

    class Training:
        training, global_rank, world_size, current_epoch = True, 0, 1, 0

        class strategy:
            root_device = torch.device("cpu")

    data.trainer = Training()  # type: ignore[assignment]
    return [data.on_after_batch_transfer(batch, 0) for batch in data.train_dataloader()]


def test_twins_come_row_by_row_and_only_where_they_are_wanted(stores: Path) -> None:
    plain = adaptation(stores, Wants())
    data = adaptation(stores, Wants("whole", again=True, target_twin=True))
    clouds, twins = data.labelled.clouds, data.labelled_domain.twins
    assert twins is not None
    for batch, before in zip(data.train_dataloader(), plain.train_dataloader(), strict=True):
        assert set(before["source"]) == {"points", "y_source"}
        assert set(before["target"]) == {"points"}
        assert torch.equal(batch["source"]["points"], before["source"]["points"])
        assert set(batch["source"]) == {"points", "y_source", "again", "twin"}
        for i, cloud in enumerate(batch["source"]["points"]):
            scans = _samples(clouds)
            which = [k for k, some in enumerate(scans) if any(torch.equal(cloud, s) for s in some)]
            (k,) = which
            own = _samples(twins)[int(clouds.rows[k])]
            assert any(torch.equal(batch["source"]["twin"][i], s) for s in own)
            assert any(torch.equal(batch["source"]["again"][i], s) for s in scans[k])
        assert torch.equal(batch["target"]["points"], before["target"]["points"])
        assert batch["target"]["twin"].shape == batch["target"]["points"].shape


def _samples(clouds: Any) -> list[list[Tensor]]:
    """Of each cloud all samples that a batch may show."""
    n = len(clouds)
    starts = [clouds.take(torch.arange(n), torch.full((n,), s)) for s in range(clouds.starts)]
    return [[some[k] for some in starts] for k in range(n)]


def test_each_twin_is_normalised_by_itself(stores: Path) -> None:
    data = adaptation(stores, Wants("whole"), scale="unit_ball")
    for batch in data.train_dataloader():
        for key in ("points", "twin"):
            assert batch["source"][key].norm(dim=2).amax(1).max() <= 1 + 1e-5
    twin = data.labelled_domain.twins
    whole = domain(stores / "s").open_array("points_whole").points
    expected = unit_ball(np.asarray(whole))[0]
    order = twin.order[0, 0]  # type: ignore[union-attr, index]
    np.testing.assert_allclose(twin.all()[0], expected[order], atol=1e-6)  # type: ignore[union-attr]


@pytest.mark.parametrize("sees", ["whole", "clean", "scan"])
def test_what_the_teacher_sees(stores: Path, sees: str) -> None:
    data = adaptation(stores, Wants(sees))
    stored = {"whole": 200, "clean": 100, "scan": 0}[sees]
    twins = data.train_dataloader().tables["source"].beside["twin"]
    assert [round(float(cloud[:, 0].mean())) for cloud in twins.stored[twins.rows]] == [
        stored + int(row) for row in data.labelled.clouds.rows
    ]


def test_scan_twin_and_second_draw_are_moved_alike_and_cut_each_alone(stores: Path) -> None:
    """With one cloud in all three places the moves can be compared point by point."""
    points = torch.randn(5, 40, 3, generator=torch.Generator().manual_seed(0))
    augment = Augment(scale=1.2, shift=0.3, lift=0.2, jitter_sigma=0.0)
    part = {"points": points, "twin": points, "again": points, "y_source": torch.arange(5)}
    generator = lambda use: torch.Generator().manual_seed(len(use))  # noqa: E731
    found = augmented(augment, part, generator, "above_floor", together=True)
    assert torch.equal(found["points"], augment(points, generator(""), "above_floor"))
    for key in ("twin", "again"):
        torch.testing.assert_close(found[key], found["points"])
    assert torch.equal(found["y_source"], torch.arange(5))
    alone = augmented(augment, part, generator, "above_floor", together=False)
    assert not torch.allclose(alone["twin"], alone["points"], atol=0.1)
    assert torch.equal(points, part["points"])

    cut = Augment(crop=0.3, drop_regions=2, rotate_z=False, jitter_sigma=0.0)
    found = augmented(cut, part, generator, "metres", together=True)
    assert torch.equal(found["twin"], points)  # whole
    distinct = {
        key: len({tuple(p) for p in found[key][0].tolist()}) for key in found if key[0] != "y"
    }
    assert distinct["points"] < 40
    assert distinct["again"] < 40
    assert not torch.equal(found["points"], found["again"])
    noisy = augmented(Augment(rotate_z=False), part, generator, "metres", together=True)
    assert not torch.equal(noisy["twin"], noisy["points"])  # jitter is each one's own


def test_wanting_twins_changes_nothing_that_was_there_before(stores: Path) -> None:
    augment = Augment(crop=0.5, lift=0.1)
    for one, other in zip(
        augmented_batches(adaptation(stores, Wants(), augment)),
        augmented_batches(adaptation(stores, Wants("clean", True, True), augment)),
        strict=True,
    ):
        for name in ("source", "target"):
            for key, value in one[name].items():
                assert torch.equal(value, other[name][key])


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 6), st.integers(0, 10_000))
def test_any_one_to_all_views_each_equally_likely(views: int, seed: int) -> None:
    draws = torch.rand(200, views + 2, generator=torch.Generator().manual_seed(seed)).numpy()
    counts = np.zeros(views)
    for draw in draws:
        chosen, noise = drawn(draw)
        assert 0 <= noise < 1
        assert len(set(chosen)) == len(chosen) <= views
        counts[len(chosen) - 1] += 1
    expected = 200 / views
    assert (np.abs(counts - expected) < 6 * np.sqrt(expected)).all()
    last = np.array([*np.linspace(0.9, 0.1, views), 0.999999, 0.5])
    assert drawn(last)[0].tolist() == list(range(views))[::-1]


def test_a_cloud_of_random_views_by_hand(stores: Path) -> None:
    arrays = [np.random.default_rng(k).normal(size=(3, 24, 3)).astype(np.float32) for k in range(4)]
    views = RandomViews(arrays[:2], arrays[2:], 8, np.array([2, 0]), "above_floor", -1.0)
    draw = torch.tensor([[0.9, 0.1, 0.2, 0.25], [0.1, 0.9, 0.7, 0.0]])  # view 1; views 0 and 1
    first, second = views.take(torch.tensor([0, 1]), draw).numpy()

    def expected(pool: np.ndarray) -> np.ndarray:
        moved = pool - pool.mean(0)
        moved[:, 2] = pool[:, 2] + 1.0
        return moved[farthest_point_sampling_np(pool - pool[:1], 8)]

    part = arrays[3][2][:16] + 0.25 * (arrays[1][2][:16] - arrays[3][2][:16])
    np.testing.assert_allclose(first, expected(part), atol=1e-5)
    both = np.concatenate([arrays[2][0][:8], arrays[3][0][:8]])  # no error at all
    np.testing.assert_allclose(second, expected(both), atol=1e-5)
    ball = RandomViews(arrays[:2], (), 8, np.arange(3), "unit_ball", 0.0)
    cloud = ball.take(torch.tensor([1]), torch.tensor([[0.9, 0.1, 0.2, 0.25]]))[0].numpy()
    moved = arrays[1][1][:16] - arrays[1][1][:16].mean(0)
    inside = moved / np.linalg.norm(moved, axis=1).max()
    assert (np.linalg.norm(cloud[:, None] - inside[None], axis=2).min(1) < 1e-5).all()


def test_random_views_are_a_function_of_seed_epoch_and_cloud(stores: Path) -> None:
    data, again, other = (
        adaptation(stores, Wants(again=True), views="random", seed=seed) for seed in (3, 3, 4)
    )
    assert data.labelled_domain.random_views is not None
    assert len(data.labelled_domain.random_views.measured) == 2
    once, twice, third = (list(d.train_dataloader()) for d in (data, again, other))
    for a, b in zip(once, twice, strict=True):
        assert torch.equal(a["source"]["points"], b["source"]["points"])
        assert not torch.equal(a["source"]["points"], a["source"]["again"])
        assert a["source"]["points"].shape == (len(a["source"]["y_source"]), M, 3)
    assert not torch.equal(once[0]["source"]["points"], third[0]["source"]["points"])
    # What validates and what is tested are the stored clouds.
    assert torch.equal(
        data.validation.clouds.all(), adaptation(stores, Wants()).validation.clouds.all()
    )


def test_of_random_views_the_scan_that_a_teacher_sees_is_the_one_that_was_drawn(
    stores: Path,
) -> None:
    for batch in adaptation(stores, Wants("scan", again=True), views="random").train_dataloader():
        assert torch.equal(batch["source"]["twin"], batch["source"]["points"])
        assert not torch.equal(batch["source"]["again"], batch["source"]["points"])
    data = DomainData(
        domain(stores / "s", views="random"), points=M, scale="metres", batch_size=4, twin="scan"
    )
    data.prepare_data()
    data.setup()
    for batch in data.train_dataloader():
        assert torch.equal(batch["twin"], batch["points"])


def test_a_store_of_one_view_varies_its_error(stores: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    points, exact = rng.normal(size=(2, N, P, 3)).astype(np.float32)
    rows = [ManifestRow(f"c{i:02d}", "ab"[i % 2], "train") for i in range(N)]
    some = {"classes": ("a", "b"), "rows": rows, "meta": {}}
    arrays = {"points": points, "points_exact": exact}
    write_pointset(tmp_path / "s", name="s", arrays=arrays, **some)
    (tmp_path / "t").symlink_to(stores / "t")
    data = adaptation(tmp_path, Wants(), views="random", points=P)
    batch = next(iter(data.train_dataloader()))
    views = data.labelled_domain.random_views
    assert views is not None
    assert len(views.measured) == len(views.exact) == 1
    assert batch["source"]["points"].shape[1:] == (P, 3)


def test_a_module_of_one_s_own_gets_twins_too(stores: Path) -> None:
    data = DomainData(
        domain(stores / "s", views="random"), points=M, scale="metres", batch_size=4, twin="whole"
    )
    data.prepare_data()
    data.setup()
    batch = next(iter(data.train_dataloader()))
    assert set(batch) == {"points", "twin", "labels", "index", "epoch"}
    assert set(next(iter(data.val_dataloader()))) == {"points", "labels", "index", "epoch"}


def test_what_is_missing_is_named(stores: Path, tmp_path: Path) -> None:
    bare = domain(stores / "t", views="random")
    with pytest.raises(ConfigError, match=r"keeps neither views nor.*twins=\[views,exact\]"):
        DomainData(bare, points=M).prepare_data()
    with pytest.raises(DataError, match=r"has no points_whole\.npy.*twins=\[whole\]"):
        DomainData(domain(stores / "t"), points=M, twin="whole").prepare_data()
    with pytest.raises(ConfigError, match="twin must be one of"):
        DomainData(domain(stores / "t"), twin="fused")
    with pytest.raises(ConfigError, match="views must be one of"):
        domain(stores / "t", views="all")
    with pytest.raises(ConfigError, match="views=random draws from what was measured"):
        domain(stores / "s", views="random", variant="points_clean")
    with pytest.raises(ConfigError, match=r"data\.target\.views=random"):
        AdaptationData(
            domain(stores / "s"), bare, phases=None, scheme=None, augment=STILL,  # type: ignore[arg-type]
            batch_size=4, seed=0,
        )  # fmt: skip


def test_old_runs_keep_their_hashes() -> None:
    """The key is new, and its default is what was there before."""
    words = ["experiment=source_only_nyu"]
    before = compose("train", words)
    with_key = config_sha256(before)
    assert before.data.source.views == "stored"
    with open_dict(before):
        del before.data.source["views"]
    assert config_sha256(before) == with_key
    drawn_anew = compose("train", [*words, "data.source.views=random"])
    assert config_sha256(drawn_anew) != with_key
