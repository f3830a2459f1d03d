"""`evaluation.norms`: with adabn the result's norms hold the target's statistics, weights stay."""

from __future__ import annotations

import torch

from qs3.config import hashing
from qs3.datamodules.clouds import load_clouds
from qs3.evaluation.norms import adapt_norms
from qs3.runs.checkpoints import load
from qs3.store.store import open_pointset
from qs3.training.command import train
from tests.training.toy import TinyNet, write_domain


def test_statistics_are_the_targets_and_weights_the_sources(toy, toy_data):
    changes = ("method=source_only", "selftraining=none")
    plain, adapted = toy(*changes), toy(*changes, "evaluation.norms=adabn")
    plain_metrics, metrics = train(plain), train(adapted)
    assert plain_metrics.evaluation.norms == "trained"
    assert metrics.evaluation.norms == "adabn"
    before = load(hashing.run_folder(plain) / "result.pt")["weights"]
    after = load(hashing.run_folder(adapted) / "result.pt")["weights"]
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed >= {"norm.running_mean", "norm.running_var"}
    assert changed <= {"norm.running_mean", "norm.running_var", "norm.num_batches_tracked"}

    target = load_clouds(open_pointset(toy_data / "kinectsim10"), "train", 32, scale="unit_ball")
    x = torch.relu(target.points @ after["lift.weight"].T + after["lift.bias"]).amax(1)  # [n, 16]
    torch.testing.assert_close(after["norm.running_mean"], x.mean(0), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(after["norm.running_var"], x.var(0), rtol=1e-4, atol=1e-5)


def test_the_net_is_asked_as_it_was_trained(toy, tmp_path):
    """The target's statistics make a net surer than it is right."""
    write_domain(tmp_path / "data", "specklenet10", noise=0.1)
    write_domain(tmp_path / "data", "kinectsim10", noise=0.6, test=12)
    changes = ("method=source_only", "selftraining=none", f"paths.data_dir={tmp_path / 'data'}")
    plain = train(toy(*changes)).quality
    adapted = train(toy(*changes, "evaluation.norms=adabn")).quality
    assert plain.expected is not None
    assert adapted.expected == plain.expected


def test_order_of_clouds_is_mixed_and_batches_are_even():
    seen = []

    class Net(TinyNet):
        def forward(self, points):
            seen.append(points[:, 0, 0].tolist())
            return super().forward(points)

    points = torch.arange(65.0)[:, None, None].expand(65, 4, 3)
    adapt_norms(Net(3), points, 16, seed=0)
    assert [len(batch) for batch in seen] == [17, 16, 16, 16]  # never one of a single cloud
    flat = [value for batch in seen for value in batch]
    assert sorted(flat) == list(range(65))
    assert flat != sorted(flat)
    seen.clear()
    adapt_norms(Net(3), points[:7], 2, seed=0)  # 3.5 batches, which rounds to 4
    assert [len(batch) for batch in seen] == [3, 2, 2]
