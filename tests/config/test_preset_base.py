"""Presets are not written over what they are made of."""

import pytest

from qs3.config.location import CONF
from qs3.config.preset_base import check_no_base
from qs3.errors import ConfigError


def test_a_preset_is_not_written_over_what_it_is_made_of(tmp_path):
    """A file whose defaults list names itself composes no more, and its values are lost."""
    folder = tmp_path / "sensor"
    folder.mkdir()
    newer, older = folder / "newer.yaml", folder / "older.yaml"
    older.write_text("defaults:\n  - realsense_d415\n  - matcher: sgbm\n  - _self_\n")
    newer.write_text("defaults:\n  - older\n  - _self_\n")
    (tmp_path / "linked.yaml").symlink_to(newer)
    place = [f"hydra.searchpath=[file://{tmp_path}]"]
    package = CONF / "sensor" / "realsense_d415.yaml"
    for out, message in (
        (newer, "is newer itself"),
        (tmp_path / "linked.yaml", "is newer itself"),
        (tmp_path / "newer.yaml", "is newer itself"),
        (older, "is older, which newer is made of"),
        (package, "is realsense_d415, which newer is made of"),
    ):
        with pytest.raises(ConfigError, match=message):
            check_no_base(out, "sensor", "newer", place)
    check_no_base(newer, "sensor", "older", place)
    check_no_base(folder / "newest.yaml", "sensor", "newer", place)
