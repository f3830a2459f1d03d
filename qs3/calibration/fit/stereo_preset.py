"""What pictures say of a preset, in words and as a file under conf/sensor."""

from __future__ import annotations

from pathlib import Path

from qs3.calibration.fit.infrared import FOCAL_BASELINE, WITHIN, InfraredFit
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.utils.files import write_text
from qs3.utils.plural import counted

_WORDS = {
    "ambient": "ambient light; a lit dot on white at 4 m has 1 at projector_strength 16",
    "infrared.psf_px": "blur of the lens, px",
    "infrared.speckle_contrast": "contrast of the laser's speckle",
    "infrared.electrons_at_white": "electrons at grey value 255 without an amplifier",
    "infrared.read_noise_e": "read-out noise, electrons",
    "infrared.white_level": "grey value that the exposure aims at",
}


def report(found: InfraredFit, base: SpeckleStereo, scenes: int) -> list[str]:
    """A line for each number, and for each that is not known."""
    lines = [f"{counted(scenes, 'scene')}, {found.distance_m:.2f} m away"]
    for key, words in _WORDS.items():
        if key in found.unknown:
            lines.append(f"{key:28} unknown: {found.unknown[key]}; {found.values[key]:.4g} stays")
            continue
        error = f" +- {found.errors[key]:.1%}" if key in found.errors else ""
        if key in found.rough:
            error += f", rough: not sure within {WITHIN:.0%}"
        lines.append(f"{key:28} {found.values[key]:.4g}{error}   ({words})")
    dots = f"{found.dots_over_ambient:.3g} at {found.distance_m:.2f} m"
    lines.append(f"{'dots over ambient':28} {dots}")
    if found.focal_baseline is None:
        stay = f"focal_px {base.focal_px:g} and baseline_m {base.baseline_m:g} stay"
        lines.append(f"{FOCAL_BASELINE:28} unknown: {found.unknown[FOCAL_BASELINE]}; {stay}")
    else:
        lines.append(
            f"{FOCAL_BASELINE:28} {found.focal_baseline:.4g} px m; with f = {base.focal_px:g} px a "
            f"baseline of {found.focal_baseline / base.focal_px:.5g} m: f and B alone cannot be "
            "told apart"
        )
    if found.gain == 1:
        lines.append(
            "the pictures are taken for unamplified: if the camera's gain was G, say gain=G, or "
            "electrons_at_white is too low by it"
        )
    else:
        lines.append(
            f"at the pictures' gain of {found.gain:g} grey value 255 is as many electrons less by "
            "it; read-out noise is what it is at this gain"
        )
    lines.append(
        "albedo, gain and projector_strength cannot be told apart: only their product is "
        f"in the pictures; projector_strength {base.projector_strength:g} stays"
    )
    if found.misfit > 3:
        lines.append(
            f"doubtful: the model is {found.misfit:.1f} standard errors off: other dots than the "
            "base's, printed surfaces, or things that move"
        )
    return lines


def save(path: Path, found: InfraredFit, name: str, base: SpeckleStereo, command: str) -> None:
    """Write the preset: the base's, with what was found in its place."""
    known = {key: value for key, value in found.values.items() if key not in found.unknown}
    lines = [
        f"# Fitted to infrared pictures from {found.distance_m:.2f} m.",
        f"# {command}",
        *(f"# not known: {key}: {why}" for key, why in found.unknown.items()),
        *(f"# rough: {key}: +- {found.errors[key]:.0%}" for key in found.rough),
        "defaults:",
        f"  - {name}",
        "  - _self_",
        "",
    ]
    if "ambient" in known:
        lines.append(f"ambient: {known['ambient']:.6g}")
    if found.focal_baseline is not None:
        lines.append(f"baseline_m: {found.focal_baseline / base.focal_px:.6g} # f B over f")
    inside = {key: value for key, value in known.items() if key.startswith("infrared.")}
    lines.append("infrared:")
    lines += [f"  {key.partition('.')[2]}: {value:.6g}" for key, value in inside.items()]
    write_text(path, "\n".join(lines) + "\n")
