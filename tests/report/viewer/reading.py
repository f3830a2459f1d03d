"""A page of clouds read back, with nothing of what wrote it."""

from __future__ import annotations

import base64
import json
import re

import numpy as np


def data_of(page: str) -> dict:
    """What the script of the page gets."""
    (text,) = re.findall(r'<script type="application/json" id="clouds">(.*?)</script>', page)
    return json.loads(text)


def places(cloud: dict) -> np.ndarray:
    """[n, 3] coordinates from the cloud's lowest corner."""
    raw = np.frombuffer(base64.b64decode(cloud["xyz"]), dtype="<u2")
    return raw.reshape(cloud["count"], 3) * cloud["step"]


def levels(cloud: dict, key: str) -> np.ndarray:
    """[n] of 0 to 255: "view" or "residual"."""
    return np.frombuffer(base64.b64decode(cloud[key]), dtype=np.uint8)
