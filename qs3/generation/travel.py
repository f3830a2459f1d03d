"""What goes along when objects are scanned elsewhere: the same software, and their meshes."""

from __future__ import annotations

import platform
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from qs3.errors import ConfigError, MeshError, RenderError
from qs3.generation.code_fingerprint import code_fingerprint
from qs3.meshes.formats.mtl import libraries
from qs3.meshes.io import load_mesh
from qs3.meshes.source import MeshItem
from qs3.utils.memory import check_memory

_LIBRARIES = ("numpy", "opencv-python-headless", "fpsample", "mitsuba", "drjit", "bpy", "trimesh")


def software() -> dict[str, str]:
    """What decides the bytes of a cloud beside the renderer, of this machine."""
    return {
        **{name: version(name) for name in _LIBRARIES},
        "python": platform.python_version(),
        "machine": platform.machine(),
        "qs3's code": code_fingerprint()[:12],
    }


def check_software(expected: Mapping[str, str], found: Mapping[str, str]) -> None:
    """Refuse to scan on a machine whose clouds would be others.

    Args:
        expected: of the machine that the command was given on.
        found: of this one.

    Raises:
        RenderError: names the machine and what differs.
    """
    if differs := [
        f"{name} is {found.get(name)} there and {expected.get(name)} here"
        for name in sorted({*expected, *found})
        if found.get(name) != expected.get(name)
    ]:
        raise RenderError(
            f"{platform.node()} would make other clouds: {'; '.join(differs)}. Install the same "
            "version of qs3 on all nodes, with constraints.txt, and name the renderer's variant "
            "(renderer.variant=llvm_ad_mono) where some have a GPU"
        )


def sent(items: Sequence[MeshItem], keep_views: bool) -> list[MeshItem]:
    """Items that take the bytes of their files along, for machines that do not see the files.

    Raises:
        ConfigError: something cannot be sent: a mesh in several files, and views if they are kept.
    """
    if keep_views:
        raise ConfigError(
            "keep_views=true writes to a disk that all nodes see: engine.shared_disk=true"
        )
    several = [item for item in items if item.path and item.path.suffix.lower() == ".gltf"]
    if several:
        raise ConfigError(
            f"{several[0].origin}: a .gltf may lie in several files, which are not sent: save it "
            "as .glb, or engine.shared_disk=true if all nodes see it"
        )
    return [replace(item, load=_Sent(item)) if item.path else item for item in items]


class _Sent:
    """Loads a mesh wherever it is called; what is pickled holds the file's content."""

    def __init__(self, item: MeshItem) -> None:
        assert item.path is not None
        assert isinstance(item.load, partial)
        self.path, self.settings = item.path, item.load.keywords
        self.content: dict[str, bytes] | None = None
        self.unreadable = ""

    def __getstate__(self) -> dict[str, Any]:
        """Read when it is sent, not before: there may be many."""
        try:
            beside = libraries(self.path) if self.settings.get("materials") else []
            check_memory(sum(p.stat().st_size for p in [self.path, *beside]), "", MeshError)
            root = self.path.parent.resolve()
            content = {str(path.relative_to(root)): path.read_bytes() for path in beside}
            content[self.path.name] = self.path.read_bytes()
            return {**self.__dict__, "content": content}
        except (OSError, MeshError) as error:  # of one object, as if it were read where it is
            return {**self.__dict__, "unreadable": str(error)}

    def __call__(self) -> Any:
        """The mesh.

        Raises:
            MeshError: as of the file where it came from.
        """
        if self.unreadable:
            raise MeshError(f"{self.path}: {self.unreadable}")
        if self.content is None:
            return load_mesh(self.path, **self.settings)
        with tempfile.TemporaryDirectory(prefix="qs3-mesh-") as folder:
            for name, content in self.content.items():
                copy = Path(folder) / name
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.write_bytes(content)
            try:
                return load_mesh(Path(folder) / self.path.name, **self.settings)
            except MeshError as error:
                raise MeshError(str(error).replace(folder, str(self.path.parent))) from error
