"""What the viewer's data on a page say."""

import base64
import json
import re

import numpy as np


def data_of(text):
    """The JSON of a page; NaN is refused, as browsers do."""

    def refused(constant):
        raise AssertionError(constant)

    (found,) = re.findall(r'id="clouds">(.*?)</script>', text, re.DOTALL)
    return json.loads(found, parse_constant=refused)


def places(cloud):
    """[n, 3] above the corner of its box."""
    raw = np.frombuffer(base64.b64decode(cloud["xyz"]), "<u2")
    return raw.reshape(-1, 3) * cloud["step"]
