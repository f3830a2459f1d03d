"""Blender in this interpreter, or in a process of another one.

bpy has wheels for few versions of Python, and each binds numpy. What renders needs neither this
interpreter nor anything but numpy, which comes with Blender: `python=PATH` names an interpreter
that has bpy, or an installed Blender, and qs3's own code is loaded there from where it lies here.
"""

import subprocess
import weakref
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge

from qs3.errors import RenderError
from qs3.geometry.cameras import Camera
from qs3.sensors.renderers.base import Image, Renderer, Scene
from qs3.sensors.renderers.blender import BlenderRenderer
from qs3.utils.settings import Count, checked

_PACKAGE = Path(__file__).resolve().parents[2]
_START = f"""
import sys
from importlib.util import module_from_spec, spec_from_file_location
spec = spec_from_file_location("qs3", {str(_PACKAGE / "__init__.py")!r})
sys.modules["qs3"] = module_from_spec(spec)
spec.loader.exec_module(sys.modules["qs3"])
from qs3.sensors.renderers.blender import serve
serve(%d)
"""


@checked
def blender(
    samples: Count = 16,
    threads: Annotated[int, Ge(0)] = 1,
    device: Literal["auto", "cpu", "gpu"] = "auto",
    python: str | None = None,
    name: str = "blender",
) -> Renderer:
    """Blender as a `Renderer`.

    Args:
        samples, threads: see `RendererSettings`.
        device: "auto" (a GPU if Blender lists one for OptiX or CUDA, else the CPU), "cpu" or
            "gpu". The two make different bytes, so a dataset's recipe says which it was.
        python: an interpreter that has bpy, or an installed Blender's program, which is called
            blender; None: this interpreter.
        name: what the configuration calls it; taken so that its node can be instantiated.
    """
    if python is None:
        return BlenderRenderer(samples, threads, device)
    settings = {"samples": samples, "threads": threads, "device": device}
    return _Elsewhere(Path(python).expanduser(), settings)


class _Elsewhere:
    """The near end of `blender.serve`; a process that died is replaced for the next scene."""

    def __init__(self, python: Path, settings: dict[str, Any]) -> None:
        self._python, self._settings = python, settings
        self._start()

    def render(
        self, scene: Scene, cameras: list[Camera], *, seed: int, geometry: list[bool]
    ) -> list[Image]:
        """Render every camera; see `Renderer.render`."""
        if self._process.poll() is not None:
            self._start()
        images: list[Image] = self._ask(
            {"scene": scene, "cameras": cameras, "seed": seed, "geometry": geometry}
        )
        return images

    def provenance(self) -> dict[str, str]:
        """Renderer, variant and library versions; see `Renderer.provenance`."""
        return dict(self._provenance)

    def _start(self) -> None:
        self._pipe, theirs = Pipe()
        code = _START % theirs.fileno()
        if self._python.name.startswith("blender"):
            options = ["--background", "--factory-startup", "--python-exit-code", "1"]
            command = [str(self._python), *options, "--python-expr", code]
        else:
            command = [str(self._python), "-I", "-c", code]
        try:
            with theirs:
                self._process = subprocess.Popen(command, pass_fds=[theirs.fileno()], stdout=2)
            weakref.finalize(self, _stop, self._pipe, self._process)
            self._provenance: dict[str, str] = self._ask(self._settings)
        except (EOFError, OSError) as error:
            raise RenderError(f"renderer.python={self._python} did not start: {error}") from error

    def _ask(self, question: dict[str, Any]) -> Any:
        try:
            self._pipe.send(question)
            answer = self._pipe.recv()
        except (EOFError, OSError) as error:
            _stop(self._pipe, self._process)
            raise EOFError("Blender's process ended (out of memory, or a crash)") from error
        if isinstance(answer, Exception):
            raise answer
        return answer


def _stop(pipe: Connection, process: subprocess.Popen[bytes]) -> None:
    pipe.close()  # at which it ends
    with suppress(subprocess.TimeoutExpired):
        process.wait(10.0)
        return
    process.kill()
    process.wait()
