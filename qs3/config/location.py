"""Where the project's config files are: `conf/` of a checkout, or what a wheel installed of it."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CONF = ROOT / "conf"
