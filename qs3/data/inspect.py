"""Look at a dataset before training on it, or at two and the gap between them.

    python -m qs3.data.inspect domain=NAME [key=value ...] [out=out/inspection/NAME]
    python -m qs3.data.inspect compare A B [key=value ...] [out=out/inspection/A-B]

What the words mean:
  domain=      a domain (conf/domain), or the folder of a dataset. Counts by class and split, sizes,
               which way is up by the shape, spacing, density, coverage, copies, leaks from train to
               test, odd objects; a contact sheet. Published files are imported first
  compare      class frequencies, spacing, density, coverage, distance to the true surface and how
               much of it was measured (of generated datasets), how well clouds tell their domain;
               one object of each class from both, as a picture
  key=value    of the domain's config: variant=points_clean, path=..., published.folder=...; and
               paths.data_dir=data. In a comparison for both, or for one: a.variant=points_clean
  sample=3000  clouds that are measured one by one; larger sets are drawn from
  seed=0       of all draws
  meshes=      folder of the meshes that a dataset was generated from, if not from the catalogue
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence

from qs3.errors import Qs3Error


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit status."""
    if not argv or argv[0] == "help" or {"-h", "--help"} & set(argv):
        sys.stdout.write(__doc__ or "")
        return 0
    try:
        from qs3.data.inspection.command import compare_command, inspect_command

        logging.basicConfig(level=logging.INFO, format="%(message)s")
        text = compare_command(argv[1:]) if argv[0] == "compare" else inspect_command(argv)
        sys.stdout.write(text + "\n")
    except Qs3Error as error:
        sys.stderr.write(f"{type(error).__name__}: {error}\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
