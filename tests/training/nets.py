"""A toy net with features of clouds and points, for methods that put heads on them."""

from __future__ import annotations

from qs3.kernels.norms import DomainNorm
from qs3.models.base import ClassHead, PointClassifier
from qs3.models.pointdan import TwoHeads
from tests.methods.shapes import TinyBackbone, TinyNodes
from tests.training.toy import TinyNet


def featured(num_classes: int) -> PointClassifier:
    """With batch norm and dropout, like the real nets."""
    backbone = TinyBackbone()
    head = ClassHead(backbone.feature_dim, num_classes, hidden=(16,), dropout=0.3)
    return PointClassifier(backbone, head)


def domained(num_classes: int) -> TinyNet:
    """A norm for each domain."""
    net = TinyNet(num_classes)
    net.norm = DomainNorm(16)
    return net


def with_nodes(num_classes: int) -> PointClassifier:
    """PointDAN's in small."""
    return PointClassifier(TinyNodes(), TwoHeads(TinyNodes.feature_dim, num_classes))


def tiny(num_classes: int, **ignored: object) -> TinyNet:
    """The toy's net, whatever settings the config of another one has: for all rows of a table."""
    return TinyNet(num_classes)
