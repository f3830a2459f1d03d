"""Every reader of files that others may have made, each with small whole files to begin with.

`test_readers.py` compares what they cover with the modules of qs3 that open files.
"""

from __future__ import annotations

from tests.fuzzing import of_datasets, of_geometry, of_runs
from tests.fuzzing.engine import Reader

READERS: tuple[Reader, ...] = (*of_geometry.READERS, *of_datasets.READERS, *of_runs.READERS)
