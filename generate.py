"""CAD meshes to point clouds: `python generate.py domain=specklenet10 meshes=PATH`."""

from qs3.generation.__main__ import main

if __name__ == "__main__":
    main()
