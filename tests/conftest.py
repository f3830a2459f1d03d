"""What all tests share."""

import os

# One thread a process: tests start many short ones, and two OpenMP teams on two cores spend
# their time waiting for each other. Set before anything imports torch.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Pictures need no screen.
os.environ.setdefault("MPLBACKEND", "Agg")

if os.environ.get("QS3_CHECK_SHAPES"):  # `make test-all`
    from jaxtyping import install_import_hook

    checked = ("geometry.neighbours", "geometry.sampling", "models", "methods")
    checked += ("datamodules.augment", "evaluation.metrics")
    install_import_hook([f"qs3.{name}" for name in checked], "beartype.beartype")
