"""From images to disparity: matchers that any sensor can use."""

from qs3.sensors.matching.base import Match, Matcher
from qs3.sensors.matching.census import CensusMatcher
from qs3.sensors.matching.correlation import ReferenceMatcher
from qs3.sensors.matching.opencv import StereoBlockMatcher

__all__ = [
    "CensusMatcher",
    "Match",
    "Matcher",
    "ReferenceMatcher",
    "StereoBlockMatcher",
]
