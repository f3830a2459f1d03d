"""Published formats, read once into the store. One format, one file.

An importer is a frozen dataclass (named by `_target_` in conf/domain) that knows where its files
are and reads them to clouds and manifest rows. Clouds keep their published scale and order;
only the axes are turned so that z is up.
"""

from qs3.datasets.importers.arrays import NamedArrays
from qs3.datasets.importers.base import Importer, import_into
from qs3.datasets.importers.deeper import lie_deeper
from qs3.datasets.importers.folders import CloudFolder
from qs3.datasets.importers.graspnet import GraspNetPC
from qs3.datasets.importers.pointda_h5 import PointDAH5
from qs3.datasets.importers.scanobjectnn import ScanObjectNN
from qs3.datasets.importers.trees import NpyTree, XyzTree

__all__ = [
    "CloudFolder",
    "GraspNetPC",
    "Importer",
    "NamedArrays",
    "NpyTree",
    "PointDAH5",
    "ScanObjectNN",
    "XyzTree",
    "import_into",
    "lie_deeper",
]
