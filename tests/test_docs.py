"""The documents: links lead somewhere, commands exist, layers and names are those of the code."""

import ast
import re
import shlex
import tomllib
from pathlib import Path
from textwrap import indent

from qs3.__main__ import ABOUT, COMMANDS
from qs3.classes import CLASSES
from qs3.utils.commands import run
from tests.composing import compose
from tests.running import main

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("docs/**/*.md"), *ROOT.glob("*.md")])


def text_of(page: str) -> str:
    return (ROOT / page).read_text("utf-8")


def test_internal_links_lead_somewhere():
    for page in PAGES:
        for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text("utf-8")):
            name, _, anchor = link.partition("#")
            target = (page.parent / name).resolve() if name else page
            if not link.startswith(("http", "mailto:")):
                assert target.is_file(), (page, link)
            if anchor and target.suffix == ".md":
                heads = re.findall(r"^#+ (.+)$", target.read_text("utf-8"), re.MULTILINE)
                words = [re.sub(r"[^\w\- ]", "", head.lower()).strip() for head in heads]
                assert anchor in [word.replace(" ", "-") for word in words], (page, link)


def test_commands_of_the_documents_exist(capsys):
    """Their `--help` knows every key that a page gives to a command of `qs3`."""
    shown: dict[tuple[str, ...], set[str]] = {}
    for page in PAGES:
        text = re.sub(r"\\\n\s*", "", page.read_text("utf-8"))  # commands of several lines
        lines = re.findall(r"^ {4}((?:qs3|python) .*)$", text, re.MULTILINE)
        for line in [*lines, *re.findall(r"`((?:qs3|python) [^`\n]+)`", text)]:
            words = shlex.split(line.split("  ")[0].split(" #")[0].replace("...", ""))
            if words[0] == "python":
                assert words[1].startswith("-") or (ROOT / words[1]).is_file(), (page, line)
            elif "COMMAND" not in line:
                name = words[1:3] if words[1] == "report" else words[1:2]
                keys = {re.split(r"[.=]", word)[0] for word in words if "=" in word}
                shown.setdefault(tuple(name), set()).update(keys)
    assert len(shown) > 10
    del shown["report", "pipeline"]  # its keys are those of generate.py
    for name, keys in shown.items():
        assert main([*name, "--help"]) == 0, name
        known = capsys.readouterr().out
        assert not {key for key in keys if key not in known}, name


def test_the_page_of_commands_is_their_help(capsys):
    assert run(COMMANDS, ["--help"], about=ABOUT) == 0
    assert indent(capsys.readouterr().out.strip(), "    ") in text_of("docs/reference/commands.md")


def test_layers_are_those_of_the_contract():
    spec = tomllib.loads(text_of("pyproject.toml"))["tool"]["importlinter"]
    (contract,) = [c["layers"] for c in spec["contracts"] if c["type"] == "layers"]
    part = text_of("docs/explanation/architecture.md").split("<!-- layers")[1].split("<!-- /")[0]
    listed = [set(re.findall(r"`(\w+)`", line)) for line in part.splitlines()[1:]]
    assert listed == [set(re.split(r"\s*[|:]\s*", line)) for line in contract]


def test_the_walk_names_what_is_there():
    """At most three files a question; a name after a file is defined, the others stand in it."""
    *questions, whole_run = text_of("docs/explanation/walk.md").split("\n## ")[1:]
    assert len(questions) == 5
    for part in questions:
        steps = re.findall(r"^\d\..*?(?=^\d\.|\Z)", part, re.MULTILINE | re.DOTALL)
        assert 1 <= len(steps) <= 3
        for step in steps:
            file, *names = re.findall(r"`([\w./]+)`", step)
            source, first = text_of(file), names[0].split(".")[0]
            defined = {n.name for n in ast.parse(source).body if hasattr(n, "name")}
            assert first in defined, (file, first)
            for word in ".".join(name for name in names if "/" not in name).split("."):
                assert re.search(rf"\b{word}\b", source), (file, word)
    assert all((ROOT / file).is_file() for file in re.findall(r"`([\w/]+\.py)`", whole_run))


def test_the_readme_example_runs(capsys):
    (block,) = re.findall(r"```python\n(.*?)```", text_of("README.md"), re.DOTALL)
    exec(compile(block, "README.md", "exec"), {})
    assert capsys.readouterr().out.strip() in CLASSES


def test_the_language_is_plain():
    """Words that a well-edited textbook seldom uses; there were 1,100 of them."""
    words = re.compile(r"\b(said|told|tells|beside|nobody|by lot|is no |are no )|\"\"\"Of ", re.I)
    texts = [path.read_text("utf-8") for path in (*PAGES, *ROOT.glob("qs3/**/*.py"))]
    assert sum(len(words.findall(text)) for text in texts) <= 110


def test_trainings_and_generations_of_the_documents_compose():
    """But for those whose config the reader is about to write."""
    lines = set()
    for page in PAGES:
        text = re.sub(r"\\\n\s*", "", page.read_text("utf-8"))
        lines |= set(re.findall(r"(?:^ {4}|`)python ((?:train|generate)\.py [^`\n]+)", text, re.M))
    own = re.compile(r"=(NAME|consistency|mean_net|margin)\b|^-|--cfg|--help")
    kept = [shlex.split(re.split(r"  | #", line)[0]) for line in lines if not own.search(line)]
    assert len(kept) > 50
    for script, *words in kept:
        words = [
            w for w in words if not w.startswith(("hydra", "$", "-m")) and "interval(" not in w
        ]
        words = [re.sub(r"^((?:seed|[\w.]*theta)=[^,]+),.*", r"\1", word) for word in words]
        compose(script.removesuffix(".py"), words)
