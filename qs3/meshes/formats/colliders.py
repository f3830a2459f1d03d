"""Nodes of a scene that stand for collisions and that nobody sees.

A game engine's invisible hulls come along in its exports. Scanned as if they were furniture, they
fill the legs of a chair. Known by the name of the node or of its mesh, in any case:

- `chair_collider`, `chair_collision`, also with a number behind: what exporters write;
- UCX_, UBX_, UCP_, USP_ and MCDCX_ before the name: Unreal Engine's static mesh pipeline;
- `-colonly` and `-convcolonly` behind it: Godot (its `-col` keeps the mesh visible).
"""

from __future__ import annotations

import re
from collections.abc import Hashable
from typing import TYPE_CHECKING

from qs3.utils.plural import counted

if TYPE_CHECKING:
    import trimesh

_NAME = re.compile(
    r"^(UCX|UBX|UCP|USP|MCDCX)_"
    r"|(^|[_\-. ])(colliders?|collisions?)([_\-. ]?\d+)*$"
    r"|-(conv)?colonly([_\-. ]?\d+)*$",
    re.IGNORECASE,
)


class Colliders:
    """Says which nodes are left out of a file or of a scene in memory, and counts them.

    Attributes:
        skip: False leaves none out.
        count: nodes left out so far.
        notes: what else a reader left out, for `load_mesh` to say.
    """

    def __init__(self, skip: bool = True) -> None:
        self.skip = skip
        self.count = 0
        self.notes: list[str] = []

    def left_out(self, *names: str | None) -> bool:
        """Whether a node with one of these names is left out; if so, it is counted."""
        found = self.skip and any(_NAME.search(str(name)) for name in names if name)
        self.count += found
        return found

    def left_out_of(self, scene: trimesh.Scene) -> set[Hashable]:
        """Nodes of trimesh's scene whose geometry is left out: colliders, and all below them.

        As in files: a node below another one that is left out is not counted again, and a mesh
        with such a name hides the node's own geometry only.
        """
        forest, hidden = scene.graph.transforms, set()
        waiting = [node for node in forest.nodes if node not in forest.parents]
        while waiting:
            node = waiting.pop()
            if self.left_out(str(node)):
                hidden |= forest.successors(node)
                continue
            if self.left_out(forest.node_data[node].get("geometry")):
                hidden.add(node)
            waiting += forest.children.get(node, ())
        return hidden

    @property
    def exception(self) -> str:
        """What follows "has no faces" where colliders were left out."""
        some = counted(self.count, "collider, which is", "colliders, which are")
        return f" but in {some} left out; see colliders=keep" if self.count else ""
