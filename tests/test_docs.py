"""The documents: links lead somewhere, commands exist, and what is said of the layers is so."""

import ast
import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from tests.composing import compose
from tests.running import main

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("docs/**/*.md"), *ROOT.glob("*.md")])
LINK = re.compile(r"\]\(([^)\s]+)\)")
INDENTED = re.compile(r"(?:^|\n)((?: {4}.*(?:\n|$))+)")
OURS = ("qs3 ", "python train.py", "python generate.py", "qs3-train", "qs3-generate")


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub and mkdocs make them."""
    found = re.findall(r"^#+ (.+)$", page.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).strip().replace(" ", "-") for head in found}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_internal_links_lead_somewhere(page):
    for link in LINK.findall(page.read_text("utf-8")):
        if link.startswith(("http", "mailto:")):
            continue
        name, _, anchor = link.partition("#")
        target = page if not name else (page.parent / name).resolve()
        assert target.is_file(), f"{link}: there is no such file"
        if anchor and target.suffix == ".md":
            assert anchor in anchors(target), f"{link}: there is no such heading"


def commands() -> dict[str, set[str]]:
    """Every command of ours that a page shows, by the words that name it, with its keys."""
    found: dict[str, set[str]] = {}
    for page in PAGES:
        text = re.sub(r"\\\n\s*", "", page.read_text("utf-8"))  # commands of several lines
        lines = [line for block in INDENTED.findall(text) for line in block.splitlines()]
        lines += re.findall(r"`((?:qs3|python) [^`\n]+)`", text)
        for line in lines:
            line = line.strip().split("  ")[0].split(" #")[0]
            if not line.startswith(OURS) or "COMMAND" in line:
                continue
            words = shlex.split(line.replace("...", ""), posix=True)
            head = [word for word in words if "=" not in word and not word.startswith("-")]
            keys = {word.partition("=")[0] for word in words if "=" in word}
            found.setdefault(" ".join(head), set()).update(keys)
    return found


def test_pages_that_code_and_configs_name_are_there():
    missing = {}
    for folder, suffix in (("qs3", "*.py"), ("conf", "*.yaml"), ("tests", "*.py")):
        for file in sorted((ROOT / folder).rglob(suffix)):
            named = re.findall(
                r"\bdocs/[\w/-]+\.(?:md|csv\.gz|csv|json|png)", file.read_text("utf-8")
            )
            if gone := [name for name in named if not (ROOT / name).is_file()]:
                missing[str(file.relative_to(ROOT))] = gone
    assert not missing


def help_of(words: list[str], capsys: pytest.CaptureFixture) -> str:
    """What `--help` of a command says: `qs3 WORDS` in this process, the others in one of theirs."""
    if words[0] == "qs3":
        assert main([*words[1:], "--help"]) == 0, words
        return capsys.readouterr().out
    module = {"qs3-train": "qs3.commands.train", "qs3-generate": "qs3.generation"}
    start = [words[1]] if words[0] == "python" else ["-m", module[words[0]]]
    done = subprocess.run(
        [sys.executable, *start, "--help"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{words} --help: {done.stderr}"
    return done.stdout


def test_commands_of_the_documents_exist(capsys):
    """Their `--help` answers, and knows every key that a page gives to a command of `qs3`."""
    shown = commands()
    assert len(shown) > 10
    helps: dict[str, str] = {}
    for command, keys in sorted(shown.items()):
        words = command.split()
        known = words[:2]
        if words[0] == "qs3":
            known = words[: 3 if words[1:2] == ["report"] and len(words) > 2 else 2]
        elif words[0] != "python":
            known = words[:1]
        name = " ".join(known)
        if name not in helps:
            helps[name] = help_of(known, capsys)
        if words[0] == "qs3" and "qs3 report pipeline" not in name and "generate" not in name:
            for key in keys:
                assert f"{key.split('.')[0]}" in helps[name], f"{name}: no help for {key}="


def contract() -> list[set[str]]:
    spec = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    (layers,) = [c for c in spec["tool"]["importlinter"]["contracts"] if c["type"] == "layers"]
    return [set(re.split(r"\s*[|:]\s*", line)) for line in layers["layers"]]


def test_layers_are_those_of_the_contract():
    page = (ROOT / "docs/explanation/architecture.md").read_text("utf-8")
    part = page[page.index("<!-- layers") : page.index("<!-- /layers")]
    listed = [set(re.findall(r"`(\w+)`", line)) for line in part.splitlines()[1:] if line]
    assert listed == contract()
    drawn = (ROOT / "docs/explanation/architecture.svg").read_text("utf-8")
    rooms = re.findall(r'y="(\d+)"[^>]*class="room">(\w+)<', drawn)
    rows: dict[str, set[str]] = {}
    for y, name in rooms:
        rows.setdefault(y, set()).add(name)
    assert list(rows.values()) == contract()


def test_every_package_says_in_a_sentence_what_it_is_for():
    for init in sorted((ROOT / "qs3").rglob("__init__.py")):
        first = init.read_text("utf-8").splitlines()[0]
        assert first.startswith(('"""', 'r"""')), init
        assert len(first) > 20, init


def test_the_root_of_the_package_holds_six_modules_at_most():
    assert len(list((ROOT / "qs3").glob("*.py"))) <= 6


def defined(file: str) -> set[str]:
    """Functions and classes of a module, and `Class.method`."""
    found: set[str] = set()
    for node in ast.parse((ROOT / file).read_text("utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            inner = [n.name for n in node.body if isinstance(n, ast.FunctionDef)]
            found |= {f"{node.name}.{name}" for name in inner}
    return found


def test_the_walk_names_what_is_there():
    """Files and names of the walk through the code; no question needs more than three files.

    What follows a file is defined there; what else its item names stands in it, at least.
    """
    page = (ROOT / "docs/explanation/walk.md").read_text("utf-8")
    *questions, whole_run = page.split("\n## ")[1:]
    for part in questions:
        files = re.findall(r"^\d\. `(qs3/[\w/]+\.py)`", part, re.MULTILINE)
        assert 1 <= len(files) <= 3
        for line in re.findall(r"^\d\..*?(?=^\d\.|\Z)", part, re.MULTILINE | re.DOTALL):
            file, *names = re.findall(r"`([\w./]+)`", line)
            assert names[0] in defined(file), f"{file} defines no {names[0]}"
            source = (ROOT / file).read_text("utf-8")
            for word in (word for name in names if "/" not in name for word in name.split(".")):
                assert re.search(rf"\b{word}\b", source), f"{file} has no {word}"
    file, *names = re.findall(r"`([\w./]+)`", whole_run)
    source = (ROOT / file).read_text("utf-8")
    places = [source.find(f" {name}(") for name in names if "/" not in name]
    assert -1 not in places
    assert places == sorted(places)  # it reads from top to bottom


def test_every_page_is_in_the_site():
    spec = yaml.safe_load((ROOT / ".ci/mkdocs.yml").read_text("utf-8"))

    def pages(node):
        if isinstance(node, str):
            return [node]
        values = node.values() if isinstance(node, dict) else node
        return [page for value in values for page in pages(value)]

    there = {str(page.relative_to(ROOT / "docs")) for page in ROOT.glob("docs/**/*.md")}
    assert set(pages(spec["nav"])) == there


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path):
    """As `make docs` does it: of docstrings, too, whose brackets may read as links."""
    pytest.importorskip("mkdocs")
    words = ["-m", "mkdocs", "build", "--strict", "-f", ".ci/mkdocs.yml", "-d", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, *words],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "reference/api/index.html").is_file()


# Lightning 2.6.6 asks torch 2.13 in an old way; not ours to fix.
@pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning")
def test_the_readme_example_runs(tmp_path, monkeypatch):
    """With a dataset of the name that it takes, and a classifier as a reader would write one."""
    from tests.training.toy import write_domain

    write_domain(tmp_path / "data", "specklenet10", noise=0.05, points=256)
    monkeypatch.chdir(tmp_path)
    (block,) = re.findall(
        r"```python\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), re.DOTALL
    )
    block = block.replace("max_epochs=5", "max_epochs=1, logger=False, enable_progress_bar=False")
    net = """
import torch
class MyClassifier(lightning.LightningModule):
    def __init__(self):
        super().__init__()
        self.net = torch.nn.Linear(3, 3)
    def training_step(self, batch, _):
        logits = self.net(batch["points"]).amax(1)
        return torch.nn.functional.cross_entropy(logits, batch["labels"])
    def validation_step(self, batch, _):
        assert len(batch["labels"]) == len(batch["points"])
    def configure_optimizers(self):
        return torch.optim.Adam(self.parameters())
"""
    exec(compile(block.replace("\ndata =", f"\n{net}\ndata =", 1), "README.md", "exec"), {})


def test_the_example_of_gradients_runs():
    """As it stands on the page; the wall is a metre away, and more ambient light is seen."""
    page = (ROOT / "docs/reference/gradients.md").read_text("utf-8")
    (block,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names: dict[str, Any] = {}
    exec(compile(block, "gradients.md", "exec"), names)
    seen = names["depth"][names["pair"].left.smooth]
    assert seen.median().item() == pytest.approx(1.0, abs=0.002)
    slope = names["settings"]["ambient"].grad
    assert torch.isfinite(slope)
    assert slope != 0


def test_the_words_that_take_out_a_threshold_fit_the_experiments_that_the_page_names():
    page = (ROOT / "docs/reference/methods.md").read_text("utf-8")
    found = re.findall(r"\(as by ([^)]*)\)[^`]*add\s`([^`]+)`", page)
    assert [word for _, word in found] == ["selftraining.theta=0", "selftraining.share=null"]
    for names, word in found:
        for name in re.findall(r"`(\w+)`", names):
            for scheme in ("cbst", "sd"):
                words = [f"experiment={name}", f"selftraining={scheme}"]
                keys = compose("train", [*words, word]).selftraining
                assert not keys.theta
                assert keys.get("share") is None
                key = word.partition("=")[0].removeprefix("selftraining.")
                assert compose("train", words).selftraining[key]  # it is set without the word


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= 130
