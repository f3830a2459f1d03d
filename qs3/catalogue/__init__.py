"""The embedded catalogue: parametric meshes of the ten classes, made from text keys alone."""

from qs3.catalogue.catalogue import Catalogue, families, make, make_parts

__all__ = ["Catalogue", "families", "make", "make_parts"]
