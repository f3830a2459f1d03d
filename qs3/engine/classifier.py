"""The LightningModule: a net, the method's loss in the warm-up, the student's in the rounds."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from jaxtyping import Float
from lightning.pytorch import LightningModule
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR, ReduceLROnPlateau

from qs3.datamodules.batches import generator_of
from qs3.datamodules.phases import Phases
from qs3.engine.cuda_graphs import Graphs
from qs3.kernels.norms import use_trained
from qs3.methods.base import Method, total_loss
from qs3.models.base import Backbone, PointClassifier
from qs3.utils.seeding import derive

# `qs3.engine.loggers.EpochRows` hands the figures on, before the checkpoint is written.
_PER_EPOCH: dict[str, Any] = dict(
    on_step=False, on_epoch=True, logger=False, prog_bar=True, sync_dist=True
)


class Classifier(LightningModule):
    """Trains a net over all phases of a run, each of which has its own schedule.

    Args:
        build_net: makes a net, [B, N, 3] to logits [B, C], drawing its weights from torch's
            global generator.
        build_optimizer: makes the optimiser of given parameters.
        method, student: losses of the warm-up and of the rounds.
        schedule: of the learning rate, "cosine" or "plateau".
        smoothing: of class labels, see `qs3.methods.base.class_loss`.
        metres: whether clouds keep their size.
        regulariser_weight: of what a backbone wants in the loss (`Features.regulariser`).
        weights: of the net, to begin with; None: new ones.
        cuda_graphs: whether one GPU replays passes as graphs.
    """

    def __init__(
        self,
        build_net: Callable[[], nn.Module],
        build_optimizer: Callable[..., torch.optim.Optimizer],
        method: Method,
        student: Method,
        phases: Phases,
        seed: int,
        schedule: str = "cosine",
        smoothing: float = 0.0,
        metres: bool = False,
        regulariser_weight: float = 0.0,
        weights: Mapping[str, Tensor] | None = None,
        cuda_graphs: bool = False,
    ) -> None:
        super().__init__()
        self.build_net, self.build_optimizer = build_net, build_optimizer
        self.phases, self.seed, self.schedule = phases, seed, schedule
        self.net = self.fresh_net(phase=0)
        if weights is not None:
            self.net.load_state_dict(weights)
        self.method, self.student = method, student
        method.smoothing = student.smoothing = smoothing
        method.metres = student.metres = metres
        self._plateau: ReduceLROnPlateau | None = None
        self._loaded_plateau: dict[str, Any] | None = None
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(derive(seed, "heads"))
            method.prepare(self.net)  # before the hooks: a method may copy the net
        self.regulariser_weight = regulariser_weight
        self._regularisers: list[Tensor] = []  # of the passes of a step
        if regulariser_weight:
            for module in self.net.modules():
                if isinstance(module, Backbone):
                    module.register_forward_hook(self._keep_regulariser)
        self._hits: list[Tensor] = []
        self.cuda_graphs = cuda_graphs
        self._graphs: Graphs | None = None

    def fresh_net(self, phase: int) -> nn.Module:
        """A net with new weights: a function of (seed, phase), whatever was drawn before."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(derive(self.seed, "init", phase))
            return self.build_net()

    def forward(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b c"]:
        """Logits."""
        return self.net(points)

    def configure_optimizers(self) -> Any:
        """One optimiser, one schedule."""
        optimizer = self._optimizer()
        if self.schedule == "cosine":
            return [optimizer], [LambdaLR(optimizer, self.phases.cosine)]
        for group in optimizer.param_groups:
            group["initial_lr"] = group["lr"]
        self._plateau = plateau(optimizer)
        if self._loaded_plateau is not None:
            self._plateau.load_state_dict(self._loaded_plateau)
            self._loaded_plateau = None
        return optimizer

    def learning_rate(self) -> float:
        """The rate of the epoch that is ending, before the hook below."""
        optimizer = self.optimizers()
        assert isinstance(optimizer, torch.optim.Optimizer)
        if self._plateau is not None:
            return float(optimizer.param_groups[0]["lr"])
        return float(optimizer.defaults["lr"] * self.phases.cosine(self.current_epoch))

    def on_train_epoch_end(self) -> None:
        """Step the plateau by hand: Lightning would do so after the epoch's checkpoint."""
        if self._plateau is not None:
            self._plateau.step(float(self.trainer.callback_metrics["train/loss"]))

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the plateau's memory."""
        if self._plateau is not None:
            checkpoint["plateau"] = self._plateau.state_dict()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep it until there is a plateau: optimisers are made later."""
        # Lightning converts to `trainer.precision` after it has loaded: float64 would be rounded.
        weights = checkpoint["state_dict"].values()
        self.to(next(value.dtype for value in weights if value.is_floating_point()))
        self._loaded_plateau = checkpoint.get("plateau")

    def on_train_start(self) -> None:
        """Make graphs where passes are on one GPU."""
        if self.cuda_graphs and self._is_on_one_gpu() and isinstance(self.net, PointClassifier):
            self._graphs = Graphs(self.net)

    def _is_on_one_gpu(self) -> bool:
        return self.device.type == "cuda" and self.trainer.world_size == 1

    def on_train_end(self) -> None:
        """Graphs keep memory."""
        if self._graphs is not None:
            self._graphs.forget()
        self._graphs = None

    def _optimizer(self) -> torch.optim.Optimizer:
        own = self.method.learning_rates(self.net)
        if not own:
            return self.build_optimizer(self.parameters())
        groups = [list(module.parameters()) for module, _ in own]
        taken = {id(p) for group in groups for p in group}
        rest = [p for p in self.parameters() if id(p) not in taken]
        optimizer = self.build_optimizer([{"params": group} for group in (rest, *groups)])
        for group, (_, factor) in zip(optimizer.param_groups[1:], own, strict=True):
            group["lr"] *= factor
        return optimizer

    def start_phase(
        self, weights: Mapping[str, Tensor] | None, *, keep_moments: bool = False
    ) -> None:
        """Go on with `weights`, or with the net's if None; forget the optimiser's moments."""
        if weights is not None:
            self.net.load_state_dict(weights)
        if self._graphs is not None:
            self._graphs.forget()
        optimizer = self.optimizers()
        assert isinstance(optimizer, torch.optim.Optimizer)
        if not keep_moments:
            optimizer.state.clear()
        if self._plateau is not None:
            for group in optimizer.param_groups:
                group["lr"] = group["initial_lr"]
            self._plateau = plateau(optimizer)

    def on_train_epoch_start(self) -> None:
        """Reseed torch (dropout draws from it): an epoch is a function of (seed, epoch).

        In the warm-up the method prepares its epoch.
        """
        if self.phases.phase(self.current_epoch) == 0:
            torch.manual_seed(derive(self.seed, "start", self.current_epoch, self.global_rank))
            data = self.trainer.datamodule  # type: ignore[attr-defined]
            self.method.start_epoch(self.net, data, self.current_epoch, self.phases.warmup)
        torch.manual_seed(derive(self.seed, "dropout", self.current_epoch, self.global_rank))

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> Tensor:
        """The loss of the current phase."""
        warmup = self.phases.phase(self.current_epoch) == 0
        method = self.method if warmup else self.student
        generator = generator_of(batch, "method", self.seed, self.global_rank, self.device)
        self._regularisers.clear()
        net: Any = self.net
        # Gradients that are summed over steps would lie where the next one's are written.
        if self._graphs is not None and self.trainer.accumulate_grad_batches == 1:
            self._graphs.begin_step()
            net = self._graphs.stand_in
        begins = batch_idx % self.trainer.accumulate_grad_batches == 0
        done = self.current_epoch + (batch_idx + 1) / int(self.trainer.num_training_batches)
        step = {"progress": min(done / self.phases.warmup, 1.0), "step_begins": begins}
        terms = method.loss(net, {**batch, **step}, generator)
        total = total_loss(method, terms)
        if self._regularisers:
            total = total + self.regulariser_weight * torch.stack(self._regularisers).sum()
        if not warmup and self.trainer.world_size > 1:  # DDP waits for the gradient of all
            total = total + sum(0.0 * p.sum() for p in self.method.parameters())
        size = max(len(part["points"]) for part in batch.values() if isinstance(part, dict))
        self.log("train/loss", total, batch_size=size, **_PER_EPOCH)
        return total

    def _keep_regulariser(self, _: nn.Module, __: Any, features: Any) -> None:
        if features.regulariser is not None and torch.is_grad_enabled():
            self._regularisers.append(features.regulariser)

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        """Count the hits on held-out labelled clouds."""
        labels = batch["source"][f"y_{self.method.labels}"]
        with use_trained(self.net, "source"):
            self._hits.append(self(batch["source"]["points"]).argmax(dim=1) == labels)

    def on_validation_epoch_end(self) -> None:
        """Log the accuracy as `<owner>_val/acc`; one process decides for all."""
        accuracy = float(torch.cat(self._hits).double().mean())
        self._hits.clear()
        accuracy = float(self.trainer.strategy.broadcast(accuracy))
        self.log(f"{self.method.labels}_val/acc", accuracy, **_PER_EPOCH)


def plateau(optimizer: Optimizer) -> ReduceLROnPlateau:
    """Half the rate after eleven epochs without a lower loss, as SimpleView's code has it."""
    return ReduceLROnPlateau(optimizer, factor=0.5, patience=10, min_lr=1e-5)
