"""The generate command, Mesh2Point: place, view, scan, fuse and sample meshes; workers, resume."""
