"""materials=PATH: kinds of material from a file of the user's."""

import subprocess
import sys

import pytest
import trimesh
import yaml
from omegaconf import OmegaConf

import qs3
from qs3.config.location import CONF
from qs3.errors import ConfigError
from qs3.generation.materials_file import MAX_BYTES, read_materials, with_materials
from qs3.generation.plan import plan_hash
from qs3.generation.plan import settings as plan_settings
from tests.generation.generating import QUICK, ROOT, composed

FELT = {"weight": 1.0, "albedo": [0.3, 0.5], "roughness": [0.9, 1]}
GLASS = {
    "weight": 2,
    "albedo": [0.02, 0.1],
    "roughness": [0.1, 0.2],
    "specular": [0.4, 0.6],
    "metal": False,
    "transmission": [0.6, 0.9],
}


def written(folder, found, name="mine.yaml"):
    path = folder / name
    path.write_text(found if isinstance(found, str) else yaml.safe_dump(found))
    return path


def of_kinds(**kinds):
    return {"materials": {"kinds": kinds}}


def plan_of(*words):
    return plan_hash({"settings": plan_settings(composed(*with_materials(words))), "objects": []})


# --- as a choice of the group


@pytest.mark.parametrize("name", ["mixed", "principled"])
def test_a_copy_of_our_own_file_is_that_choice(name, tmp_path):
    path = written(tmp_path, (CONF / "materials" / f"{name}.yaml").read_text())
    own = composed(*with_materials(["domain=specklenet10", f"materials={path}"]))
    ours = composed("domain=specklenet10", f"materials={name}")
    assert OmegaConf.to_container(own) == OmegaConf.to_container(ours)


def test_all_fields_arrive_and_later_words_change_them(tmp_path):
    path = written(tmp_path, of_kinds(felt=FELT, glass=GLASS))
    words = ["domain=specklenet10", f"materials='{path}'", "materials.kinds.felt.weight=0.25"]
    plain = OmegaConf.to_container(composed(*with_materials(words)), resolve=True)
    assert plain["materials"]["kinds"] == {"felt": {**FELT, "weight": 0.25}, "glass": GLASS}
    assert plain["recipe"]["materials"] == plain["materials"]
    assert plain["materials"]["max_materials"] == 3


def test_the_plan_s_hash_is_of_the_content_and_not_of_the_place(tmp_path):
    (tmp_path / "b c").mkdir()
    here = written(tmp_path, of_kinds(felt=FELT))
    there = written(tmp_path / "b c", of_kinds(felt=FELT), "other.yml")
    changed = written(tmp_path, of_kinds(felt={**FELT, "weight": 3}), "changed.yaml")
    hashes = [plan_of("domain=specklenet10", f"materials={p}") for p in (here, there, changed)]
    assert hashes[0] == hashes[1] != hashes[2]


def test_words_that_are_no_paths_stay_as_they_are():
    words = ["materials=mixed", "meshes=a/b", "light=area", "--cfg", "job"]
    assert with_materials(words) == words


def test_a_scan_from_memory_takes_a_path_too(tmp_path):
    path = written(tmp_path, of_kinds(felt={**FELT, "albedo": [0.5, 0.5]}))
    words = ("domain=specklenet10", *QUICK, "views=1")
    box = trimesh.creation.box((0.5, 0.5, 0.5))
    own, matt = (qs3.generate(box, *words, *more) for more in ([f"materials={path}"], []))
    pictures = [scan.frames[0].images["left"] for scan in (own, matt)]
    assert (pictures[0] != pictures[1]).any()


def test_the_command_reads_it_and_says_what_is_wrong_in_a_line(tmp_path):
    def said(path):
        words = [sys.executable, "generate.py", f"materials={path}", "--cfg", "job"]
        return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)

    good = said(written(tmp_path, of_kinds(felt=FELT)))
    assert "felt:" in good.stdout, good.stderr
    bad = said(written(tmp_path, of_kinds(felt={**FELT, "albedo": [0.3, 1.5]}), "bad.yaml"))
    assert bad.returncode == 1
    (line,) = bad.stderr.splitlines()
    assert line.startswith(f"ConfigError: {tmp_path}/bad.yaml: materials.kinds.felt.albedo must be")


# --- untrusted


@pytest.mark.parametrize(
    ("found", "message"),
    [
        ("", "the file must hold the keys materials"),
        ("- 1", "the file must hold the keys materials"),
        ("a: [", "is not YAML|not readable"),
        ("materials: !!python/object/apply:os.system [ls]", "not readable"),
        ("materials: &a {kinds: *a}", "stands for itself"),
        ({"defaults": ["mixed"], **of_kinds(felt=FELT)}, r"mine\.yaml: defaults is not known"),
        ({**of_kinds(felt=FELT), "recipe": {"materials": "${a}"}}, "recipe: may say materials"),
        ({**of_kinds(felt=FELT), "recipe": {"_target_": "os.abort"}}, "recipe: may say materials"),
        (
            {"materials": {"kinds": {"felt": FELT}, "_target_": "os.abort"}},
            r"materials\._target_ m",
        ),
        ({"materials": {"kinds": {"felt": FELT}, "most": 3}}, r"materials\.most is not known"),
        (
            {"materials": {"kinds": {"felt": FELT}, "max_materials": 0}},
            "max_materials must be a wh",
        ),
        ({"materials": {}}, r"materials\.kinds is missing"),
        (of_kinds(), "must name 1 to 256 kinds"),
        ({"materials": {"kinds": [FELT]}}, "must name 1 to 256 kinds"),
        (of_kinds(felt={**FELT, "_target_": "os.abort"}), r"kinds\.felt\._target_ is not known"),
        (of_kinds(felt={**FELT, "colour": [0, 1]}), r"kinds\.felt\.colour is not known"),
        (of_kinds(felt={"weight": 1, "albedo": [0, 1]}), r"kinds\.felt\.roughness is missing"),
        (of_kinds(felt=[1, 2]), r"kinds\.felt must hold the keys weight"),
        (
            of_kinds(felt={**FELT, "weight": float("inf")}),
            r"felt\.weight must be in \[0, 1000000\]",
        ),
        (of_kinds(felt={**FELT, "weight": float("nan")}), r"felt\.weight must be in"),
        (of_kinds(felt={**FELT, "weight": "${oc.env:HOME}"}), r"felt\.weight must be a number"),
        (of_kinds(felt={**FELT, "albedo": ["${a}", 1]}), r"felt\.albedo must be a number"),
        (of_kinds(felt={**FELT, "albedo": "01"}), r"felt\.albedo must be \[lowest, highest\]"),
        (of_kinds(felt={**FELT, "roughness": [0, 1]}), r"felt\.roughness must be in \[0\.1, 1\]"),
        (of_kinds(felt={**FELT, "metal": "yes, please"}), r"felt\.metal must be true or false"),
        (of_kinds(felt={**FELT, "transmission": [0, 1]}), r"felt\.transmission must be in"),
        (of_kinds(felt={**FELT, "weight": 0}), "no kind has a weight above 0"),
        ({"materials": {"kinds": {"a},b:{": FELT}}}, "is no name"),
        ({"materials": {"kinds": {True: FELT}}}, "True is no name"),
        ({"materials": {"kinds": {"null": FELT}}}, "'null' is no name"),
        ("x" * (MAX_BYTES + 1), "more than 262144 bytes"),
    ],
)
def test_what_is_refused_is_named_with_its_file_and_key(found, message, tmp_path):
    path = written(tmp_path, found)
    with pytest.raises(ConfigError, match=message) as caught:
        read_materials(path)
    assert str(path) in str(caught.value)


def test_files_that_are_not_there_or_not_text(tmp_path):
    for word in (f"materials={tmp_path}/none.yaml", f"materials={tmp_path}/"):
        with pytest.raises(ConfigError, match=r"there is no such file|is not a file"):
            with_materials([word])
    path = tmp_path / "a.yaml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match=r"a\.yaml: is not text in UTF-8"):
        read_materials(path)
