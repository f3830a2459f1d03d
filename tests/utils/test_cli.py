"""The dialect of all commands: help, keys, errors, and how they end."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from qs3.__main__ import QS3
from qs3.datasets.scannet.settings import Extraction
from qs3.errors import ConfigError
from qs3.utils.cli import (
    FLAG,
    NUMBER,
    Command,
    Group,
    Option,
    one_of,
    run,
    several,
    text,
    whole,
)
from qs3.utils.version import VERSION

ROOT = Path(__file__).parents[2]
GIVEN: dict = {}
ECHO = Command(
    "qs3 echo",
    "keeps what it gets",
    lambda **given: GIVEN.update(given),
    (
        Option("path", text("PATH"), "where", required=True),
        Option("data_dir", text("FOLDER"), "the data", "data"),
        Option("count", whole(2), "how many", 3),
        Option("share", NUMBER, "how much"),
        Option("law", one_of("near", "far"), "which"),
        Option("quick", FLAG, "less", False),
        Option("seeds", several(whole(0)), "of runs", (0, 1), choices=lambda: ["7", "8"]),
    ),
    ("qs3 echo path=here",),
    words="FILES",
    others={"sensor.": "settings"},
    line=True,
)
GROUP = Group("qs3", "everything", {"echo": ECHO}, ("qs3 echo path=x",), default="echo")


def commands(group: Group) -> list[list[str]]:
    """The words of every command, and of every group, below a group."""
    found = [[]]
    for word in group.commands:
        one = group.command(word)
        found += [[word, *rest] for rest in (commands(one) if isinstance(one, Group) else [[]])]
    return found


def test_values_have_their_kinds():
    words = ["echo", "a.png", "path=x=y", "paths.data_dir=/d", "count=2", "share=1e-3", "law=far"]
    assert run(GROUP, [*words, "quick=True", "seeds=[4, 5]", "sensor.gain=2", "b c.png"]) == 0
    assert GIVEN == {
        "path": "x=y", "data_dir": "/d", "count": 2, "share": 0.001, "law": "far", "quick": True,
        "seeds": (4, 5), "words": ["a.png", "b c.png"], "more": ["sensor.gain=2"],
        "line": "qs3 echo a.png path=x=y paths.data_dir=/d count=2 share=1e-3 law=far quick=True "
        "'seeds=[4, 5]' sensor.gain=2 'b c.png'",
    }  # fmt: skip
    assert run(GROUP, ["path=x"]) == 0  # the default command
    defaults = {"data_dir": "data", "count": 3, "share": None, "law": None, "quick": False}
    assert GIVEN.items() >= {**defaults, "seeds": (0, 1), "words": [], "more": []}.items()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["ehco"], "unknown command 'ehco'; did you mean echo? (see qs3 --help)"),
        (["zzz"], "unknown command 'zzz'; there are echo"),
        (["echo"], "path=PATH is missing; for example: qs3 echo path=here (see qs3 echo --help)"),
        (["echo", "path=x", "cuont=1"], "unknown key 'cuont'; did you mean count=?"),
        (["echo", "path=x", "z=1"], "unknown key 'z'; keys are path, data_dir, count"),
        (["echo", "path=x", "path=y"], "path= is given twice"),
        (["echo", "path="], "path must be text, got ''"),
        (["echo", "path=x", "law="], "got ''; for the default leave law= out"),
        (["echo", "path=x", "count=1"], "count must be a whole number of at least 2, got '1'"),
        (["echo", "path=x", "count=two"], "count must be a whole number of at least 2, got 'two'"),
        (["echo", "path=x", "share=much"], "share must be a number, got 'much'"),
        (["echo", "path=x", "law=here"], "law must be near or far, got 'here'"),
        (["echo", "path=x", "quick=yes"], "quick must be true or false, got 'yes'"),
        (
            ["echo", "path=x", "seeds=1,-1"],
            "seeds must be a whole number of at least 0, or several",
        ),
    ],
)
def test_mistakes_are_one_line_and_status_1(words, message, capsys):
    assert run(GROUP, words) == 1
    error = capsys.readouterr().err
    assert error.startswith("ConfigError: ")
    assert message in error
    assert error.count("\n") == 1


def test_words_are_refused_where_none_belong():
    with pytest.raises(ConfigError, match="'scans' is not key=value; keys are ckpt, out, judged"):
        QS3.command("export").parse(["ckpt=x", "scans"])


def test_one_bare_word_may_stand_for_a_key():
    inspect = QS3.command("inspect")
    assert inspect.parse(["modelnet10", "sample=9"]) == inspect.parse(
        ["domain=modelnet10", "sample=9"]
    )
    assert inspect.help().startswith("qs3 inspect NAME|FOLDER: ")
    for first in ("modelnet10", "domain=modelnet10"):
        with pytest.raises(ConfigError, match="one NAME or FOLDER is enough, and shapenet10 is"):
            inspect.parse([first, "shapenet10"])
    with pytest.raises(ConfigError, match="domain= is given twice"):
        inspect.parse(["modelnet10", "domain=shapenet10"])
    with pytest.raises(ConfigError, match="'--sample' is not key=value"):
        inspect.parse(["modelnet10", "--sample"])
    with pytest.raises(ConfigError, match=r"domain=NAME\|FOLDER is missing"):
        inspect.parse(["variant=x"])


def test_places_may_begin_with_the_home_folder(tmp_path, monkeypatch):
    """Shells but bash leave ~ behind =; of what is no file or folder it is a letter.

    A file may be called ~me, too, if nobody is: it keeps its name whoever looks for homes later.
    """
    monkeypatch.setenv("HOME", "/home/me")
    monkeypatch.chdir(tmp_path)
    keys = {"into": text("FOLDER"), "runs": several(text("PATH")), "row": text("NAME")}
    options = tuple(Option(key, kind, "what") for key, kind in keys.items())
    command = Command("qs3 x", "x", lambda **_: 0, options, ("qs3 x",))
    assert command.parse(["into=~/data", "runs=~/a,b/~,~me/c", "row=~/x"]) == {
        "into": "/home/me/data",
        "runs": ("/home/me/a", "b/~", f"{tmp_path}/~me/c"),
        "row": "~/x",
    }


def test_an_example_of_two_lines_is_shown_whole():
    with pytest.raises(ConfigError) as told:
        QS3.command("fit").parse([])
    assert "\\" not in str(told.value)
    assert re.search(r"for example: qs3 fit \S.* out=\S+ .*\(see qs3 fit --help\)", str(told.value))


def test_a_key_that_any_domain_might_have_is_named_if_one_is_missing():
    with pytest.raises(ConfigError, match=r"domain=NAME\|FOLDER is missing; not domian="):
        QS3.command("inspect").parse(["domian=modelnet10", "variant=x"])


@pytest.mark.parametrize("words", commands(QS3), ids=" ".join)
@pytest.mark.parametrize("ask", [["--help"], ["-h"], ["help"]], ids=" ".join)
def test_help_of_every_command(words, ask, capsys):
    assert run(QS3, [*words, *ask]) == 0
    page = capsys.readouterr().out
    assert page.startswith(" ".join(["qs3", *words]))
    assert page.splitlines()[2].startswith("    qs3 ")  # an example
    assert max(map(len, page.splitlines())) <= 100
    assert len(page.splitlines()) < 60
    assert run(QS3, ["help", *words]) == 0
    assert capsys.readouterr().out == page


@pytest.mark.parametrize("word", ["--version", "version"])
def test_version(word, capsys):
    assert run(QS3, [word]) == 0
    assert capsys.readouterr().out == f"qs3 {VERSION}\n"


def test_help_shows_defaults_and_choices():
    shown = ECHO.help()
    assert "path=PATH" in shown
    assert "where (required)" in shown
    assert "how many (default 3)" in shown
    assert "of runs; one of 7, 8 (default 0,1)" in shown
    assert "sensor.KEY=VALUE" in shown
    scannet = QS3.command("scannet")
    values = {option.key: option.default for option in scannet.options}
    assert values.items() >= vars(Extraction()).items()


def test_a_long_list_is_broken_behind_its_commas():
    keys = [f"sensor.infrared.number_{i}" for i in range(9)]
    option = Option("keys", text("KEY,..."), "of 1,000 that are tuned", ",".join(keys))
    page = Command("qs3 x", "is", print, (option,), ("qs3 x",)).help()
    assert all(key in page for key in keys)
    assert "of 1,000 that" in page
    assert "\0" not in page
    assert max(map(len, page.splitlines())) <= 100


def test_every_example_is_understood():
    """Continued lines and those of other commands aside."""
    tried = 0
    for words in commands(QS3):
        command = QS3
        for word in words:
            command = command.command(word)
        for example in command.examples if isinstance(command, Command) else ():
            name, _, rest = example.partition(command.name + " ")
            if name or not rest or rest.endswith("\\"):
                continue
            command.parse(shlex.split(rest.split("   ")[0]))
            tried += 1
    assert tried > 20


def start(words: list[str], **more) -> subprocess.Popen:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen([sys.executable, *words], env=environment, text=True, **more)


def test_help_is_light_and_quick(tmp_path):
    code = (
        "import sys; from qs3.__main__ import QS3; QS3(['--help']); QS3(['report', '--help']);"
        "sys.exit(', '.join({'torch', 'numpy', 'hydra', 'omegaconf'} & set(sys.modules)))"
    )
    done = start(["-c", code], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, cwd=tmp_path)
    assert done.communicate()[1].strip() == ""


@pytest.mark.parametrize(
    "words",
    [["-m", "qs3", "--help"], ["-m", "qs3", "download"], ["train.py", "--cfg", "all"],
     ["generate.py", "help"]],
)  # fmt: skip
def test_a_reader_that_has_seen_enough_ends_it_quietly(words):
    """As `| head -1`; the pipe is closed before anything is written."""
    reader, writer = os.pipe()
    os.close(reader)
    process = start(words, stdout=writer, stderr=subprocess.PIPE, cwd=ROOT)
    os.close(writer)
    assert process.communicate()[1] == ""
    assert process.returncode in (128 + signal.SIGPIPE, -signal.SIGPIPE)


def test_ctrl_c_says_what_comes_next(capsys):
    def interrupted() -> None:
        raise KeyboardInterrupt

    assert run(Command("qs3 x", "", interrupted, (), ()), []) == 130
    assert capsys.readouterr().err == "\ninterrupted; run the same command again and it continues\n"


def test_ctrl_c_ends_a_hydra_command(tmp_path):
    """Status 130 and one line, whether it comes in Hydra or, as Lightning ends, as SystemExit."""
    for error in ("raise KeyboardInterrupt", "try: raise KeyboardInterrupt\n except: sys.exit(1)"):
        code = (
            "import sys\nfrom qs3.utils.cli import hydra_command\n"
            f"@hydra_command\ndef main():\n {error}\nmain()"
        )
        process = start(["-c", code], stderr=subprocess.PIPE, cwd=tmp_path)
        assert process.communicate()[1].strip().startswith("interrupted; run the same command")
        assert process.returncode == 130


def test_sigterm_ends_a_hydra_command(tmp_path):
    """Status 143 and one line, after what is to be put away was put away; a second one at once."""
    code = (
        "import os, signal, sys\nfrom qs3.utils.cli import hydra_command\n"
        "@hydra_command\ndef main():\n"
        " try:\n  os.kill(os.getpid(), signal.SIGTERM)\n"
        " finally:\n  print('put away', flush=True)\n  {more}\nmain()"
    )
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "cwd": tmp_path}
    process = start(["-c", code.format(more="pass")], **pipes)
    said = "\nterminated; run the same command again and it continues\n"
    assert process.communicate() == ("put away\n", said)
    assert process.returncode == 143
    process = start(["-c", code.format(more="os.kill(os.getpid(), signal.SIGTERM)")], **pipes)
    assert process.communicate() == ("put away\n", "")
    assert process.returncode == -signal.SIGTERM


def test_a_command_without_its_seed_ends_in_words(tmp_path):
    code = (
        "from omegaconf import OmegaConf\nfrom qs3.utils.cli import hydra_command\n"
        "@hydra_command\ndef main():\n OmegaConf.create({'a': '${b}'}).a\nmain()"
    )
    process = start(["-c", code, "~b"], stderr=subprocess.PIPE, cwd=tmp_path)
    said = process.communicate()[1]
    assert said.splitlines() == [
        "ConfigError: a: Interpolation key 'b' not found", "leave out ~b, which deletes it",
    ]  # fmt: skip
    assert process.returncode == 1


@pytest.mark.parametrize(
    "how", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_ctrl_c_while_generating(how, tmp_path):
    process = start(
        ["generate.py", "domain=modelnet10", "workers=1", f"paths.data_dir={tmp_path}"],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    while not list(tmp_path.glob("modelnet10/*")) and process.poll() is None:
        time.sleep(0.1)
    process.send_signal(how)
    said = process.communicate(timeout=120)[1]
    assert process.returncode == 128 + how, said
    assert "Traceback" not in said
    assert said.endswith("ed; run the same command again and it continues\n")
