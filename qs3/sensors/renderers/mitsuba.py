"""Mitsuba 3: the fast renderer, on the CPU (LLVM, scalar) or an NVIDIA GPU (CUDA).

With a compiled ("JIT") variant the whole measurement (ray, hit, slide, shadow ray, sum over
samples) is one kernel of ours, traced once and then used for every scene, window and number
of samples. Mitsuba's own integrators would be compiled again for each window size, which
costs more than the render. The scalar variant cannot trace kernels: Mitsuba's `direct` integrator
and its `projector` emitter do the same there.
"""

import os
from importlib.metadata import version
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge

from qs3.errors import RenderError
from qs3.geometry.cameras import Camera, Intrinsics
from qs3.meshes.mesh import Mesh
from qs3.sensors.renderers import llvm
from qs3.sensors.renderers.base import (
    Body,
    Image,
    Projector,
    RendererSettings,
    Scene,
    give_memory_back,
)
from qs3.sensors.renderers.mitsuba_glossy import GlossyScene
from qs3.sensors.renderers.mitsuba_jit import JitScene, Solid
from qs3.sensors.renderers.mitsuba_scalar import ScalarScene
from qs3.utils.settings import Count, checked


class MitsubaRenderer:
    """A `Renderer` on Mitsuba 3."""

    @checked
    def __init__(
        self,
        samples: Count = 16,
        threads: Annotated[int, Ge(0)] = 1,
        variant: str = "auto",
        name: str = "mitsuba",
    ) -> None:
        """Find a variant that works here and load it.

        Args:
            samples, threads: see `RendererSettings`.
            variant: "auto", or a Mitsuba variant ("llvm_ad_mono", "cuda_ad_mono", "scalar_rgb").
            name: what the configuration calls it; taken so that its node can be instantiated.
        """
        self.settings = RendererSettings(samples, threads)
        self._probe = llvm.find_variant(variant)
        self.variant = self._probe.variant
        self._solid: Solid | None = None
        self._activate()

    def render(
        self, scene: Scene, cameras: list[Camera], *, seed: int, geometry: list[bool]
    ) -> list[Image]:
        """Render every camera; see `Renderer.render`."""
        import drjit as dr

        mi = self._activate()
        try:
            built = self._build(mi, scene)
            images = []
            for index, (camera, wanted) in enumerate(zip(cameras, geometry, strict=True)):
                # Cameras of one call must not share their sampling noise.
                camera_seed = (seed + 0x9E3779B9 * index) % 2**32
                radiance = built.radiance(camera, self.settings.samples, camera_seed)
                if wanted:
                    depth_m, face = built.geometry(camera)
                    images.append(Image(radiance, depth_m, *built.faces.seen(camera, face)))
                else:
                    images.append(Image.without_geometry(radiance))
        except RuntimeError as error:
            raise RenderError(f"Mitsuba ({self.variant}) failed: {error}") from error
        finally:
            dr.flush_malloc_cache()  # it keeps what it frees, by size; every object has other sizes
            give_memory_back()
        return images

    def provenance(self) -> dict[str, str]:
        """Renderer, variant and library versions; see `Renderer.provenance`."""
        found = {
            "renderer": "mitsuba",
            "variant": self.variant,
            "mitsuba": version("mitsuba"),
            "drjit": version("drjit"),
            "samples": str(self.settings.samples),
        }
        if self._probe.llvm_path is not None:
            number = ".".join(map(str, llvm.libllvm_version(self._probe.llvm_path)))
            found["llvm"] = number or os.path.basename(self._probe.llvm_path)
        if self._width not in (None, llvm.WIDTH):
            found["width"] = str(self._width or "unknown")  # other bytes than elsewhere
        return found

    def _build(self, mi: Any, scene: Scene) -> ScalarScene | JitScene:
        if not self.variant.startswith("scalar_"):
            if self._solid is None or self._solid.bodies is not scene.bodies:
                self._solid = Solid(mi, scene.bodies)  # most pictures show what the last one did
            return (JitScene if scene.plain else GlossyScene)(mi, scene, self._solid)
        if not scene.plain:
            raise RenderError(
                f"renderer.variant={self.variant} has matt surfaces and even light only: install "
                "a libLLVM (libllvm19), or leave out materials= and light="
            )
        return ScalarScene(mi, scene)

    def _activate(self) -> Any:
        """Mitsuba with our variant and threads, whatever else in this process used it since."""
        if self._probe.llvm_path is not None:
            os.environ.setdefault(llvm.LIBRARY_VARIABLE, self._probe.llvm_path)
        import drjit as dr
        import mitsuba as mi

        try:
            if mi.variant() != self.variant:
                mi.set_variant(self.variant)
        except (ImportError, RuntimeError) as error:
            raise RenderError(f"Mitsuba cannot load its variant {self.variant}: {error}") from error
        self._width = llvm.fix_width() if self.variant.startswith("llvm_") else None
        threads = self.settings.threads or os.cpu_count() or 1
        if dr.thread_count() != threads:
            dr.set_thread_count(threads)
        return mi


def render_probe_scene(variant: str) -> None:
    """Render a small scene that uses every kernel; run in a child process by `llvm`."""
    # The probe itself must not probe: hand it the answer that it is about to verify.
    path = os.environ.get(llvm.LIBRARY_VARIABLE) if variant.startswith("llvm_") else None
    renderer = object.__new__(MitsubaRenderer)
    renderer.settings = RendererSettings(samples=2)
    renderer.variant = variant
    renderer._probe, renderer._solid = llvm.Probe(variant, path), None
    vertices = np.array([[-1, -1, 2], [1, -1, 2], [1, 1, 2], [-1, 1, 2]], dtype=np.float64)
    body = Body(Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]])))
    projector = Projector(np.eye(4), np.ones((8, 8), dtype=np.float32), tan_half_width=1.0)
    camera = Camera(Intrinsics.centred(8, 8, 16.0), np.eye(4))
    (image,) = renderer.render(
        Scene((body,), projector, ambient=0.5), [camera], seed=0, geometry=[True]
    )
    expected = body.albedo * (0.5 + 1 / 4)
    if not np.allclose(image.radiance, expected, rtol=1e-3) or not np.allclose(image.depth_m, 2):
        raise SystemExit(f"variant {variant} renders wrong values")
