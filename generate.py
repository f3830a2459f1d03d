"""CAD meshes to point clouds: `python generate.py domain=specklenet10 meshes=PATH`."""

from pathlib import Path

from qs3.utils.environment import needs_packages

with needs_packages(Path(__file__).parent):
    from qs3.generation.__main__ import main

if __name__ == "__main__":
    main()
