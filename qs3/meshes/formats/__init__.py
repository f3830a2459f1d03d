"""One module for one file format: bytes in, (vertices [V, 3], triangles [F, 3]) out."""
