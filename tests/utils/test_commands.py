"""The dialect of all commands: help, keys, errors, and how they end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated, Literal

import pytest
from annotated_types import Ge

from qs3.__main__ import COMMANDS
from qs3.errors import ConfigError
from qs3.utils.commands import parse, run
from qs3.utils.version import VERSION

ROOT = Path(__file__).parents[2]
GIVEN: dict = {}


def echo(
    path: Annotated[Path, "where"],
    *words: Annotated[str, "files"],
    data_dir: Annotated[Path, "the data"] = Path("data"),
    count: Annotated[int, Ge(2), "how many"] = 3,
    share: Annotated[float | None, "how much"] = None,
    law: Annotated[Literal["near", "far"] | None, "which"] = None,
    quick: Annotated[bool, "less"] = False,
    seeds: Annotated[tuple[int, ...], "of runs"] = (0, 1),
    **more: Annotated[str, "settings"],
) -> None:
    """Keep what it gets.

    Example:
        qs3 echo here
    """
    GIVEN.clear()
    GIVEN.update({**locals(), "more": more})


TABLE = {"echo": f"{__name__}:echo", "": f"{__name__}:echo"}


def words_of(commands) -> list[list[str]]:
    """The words of every command, and of every group."""
    found = [[]]
    for word, one in commands.items():
        if word:
            found += [[word, *rest] for rest in ([[]] if isinstance(one, str) else words_of(one))]
    return found


def test_values_have_their_types():
    words = ["echo", "a.png", "paths.data_dir=/d", "count=2", "share=1e-3", "law=far"]
    assert run(TABLE, [*words, "quick=True", "seeds=[4, 5]", "sensor.gain=2", "b c.png"]) == 0
    assert {
        "path": Path("a.png"), "data_dir": Path("/d"), "count": 2, "share": 0.001, "law": "far",
        "quick": True, "seeds": (4, 5), "words": ("b c.png",), "more": {"sensor.gain": "2"},
    } == GIVEN  # fmt: skip
    assert run(TABLE, ["path=x=y"]) == 0  # the default command
    assert GIVEN["path"] == Path("x=y")
    assert GIVEN["seeds"] == (0, 1)


@pytest.mark.parametrize(
    "words",
    [
        ["count=3"], ["x", "count=1"], ["x", "count=two"], ["x", "law=here"], ["x", "share=nan"],
        ["x", "quick=perhaps"], ["x", "seeds=1,a"], ["path=x", "path=y"],
    ],
)  # fmt: skip
def test_mistakes_are_errors(words):
    with pytest.raises(ConfigError):
        parse(echo, words)


def test_an_unknown_key_is_answered_with_those_there_are():
    def strict(points: int = 3) -> None:
        """Nothing."""

    with pytest.raises(ConfigError, match="'pionts'; there are points"):
        parse(strict, ["pionts=4"])


def test_the_home_folder(monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    _, given = parse(echo, ["~/a", "data_dir=~/data"])
    assert (given["path"], given["data_dir"]) == (Path("/home/me/a"), Path("/home/me/data"))


@pytest.mark.parametrize("words", words_of(COMMANDS), ids=" ".join)
def test_help_of_every_command(words, capsys):
    assert run(COMMANDS, [*words, "--help"]) == 0
    page = capsys.readouterr().out
    assert page.startswith(" ".join(["qs3", *words]))
    assert max(map(len, page.splitlines())) <= 100


def test_version(capsys):
    assert run(COMMANDS, ["--version"]) == 0
    assert capsys.readouterr().out == f"qs3 {VERSION}\n"


def test_an_error_is_one_line_and_status_1(capsys):
    assert run(TABLE, ["ehco"]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def start(words: list[str], **more) -> subprocess.Popen:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen([sys.executable, *words], env=environment, text=True, **more)


def test_help_is_light(tmp_path):
    heavy = "{'torch', 'numpy', 'hydra', 'omegaconf', 'pydantic'}"
    code = (
        "import sys; from qs3.__main__ import COMMANDS; from qs3.utils.commands import run;"
        "run(COMMANDS, ['--help']); run(COMMANDS, ['report', '--help']);"
        f"sys.exit(', '.join({heavy} & set(sys.modules)))"
    )
    done = start(["-c", code], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, cwd=tmp_path)
    assert done.communicate()[1].strip() == ""


def test_a_reader_that_has_seen_enough_ends_it_quietly():
    """As `| head -1`; the pipe is closed before anything is written."""
    reader, writer = os.pipe()
    os.close(reader)
    process = start(["-m", "qs3", "--help"], stdout=writer, stderr=subprocess.PIPE, cwd=ROOT)
    os.close(writer)
    assert process.communicate()[1] == ""
    assert process.returncode == 128 + signal.SIGPIPE


def test_signals_end_a_hydra_command(tmp_path):
    """With the shell's status, after what is to be put away was put away; a second one at once."""
    for name, status in (("SIGINT", 130), ("SIGTERM", 143)):
        code = (
            "import os, signal, sys\nfrom qs3.utils.commands import hydra_command\n"
            "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
            "@hydra_command\ndef main():\n"
            f" try:\n  os.kill(os.getpid(), signal.{name})\n"
            " finally:\n  print('put away', flush=True)\nmain()"
        )
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "cwd": tmp_path}
        process = start(["-c", code], **pipes)
        out, err = process.communicate()
        assert (out, process.returncode) == ("put away\n", status)
        assert "run the same command again" in err


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
