"""CAD meshes to point clouds: `python generate.py domain=specklenet10 meshes=PATH`."""

from qs3.commands.generate import main

if __name__ == "__main__":
    main()
