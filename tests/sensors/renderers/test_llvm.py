import json
import os
import subprocess

import pytest

from qs3.errors import RenderError
from qs3.sensors.renderers import llvm


@pytest.fixture(autouse=True)
def _fresh_probe(monkeypatch):
    # setenv first, so that what a test stores there is undone even if it was unset before
    monkeypatch.setenv(llvm.PROBE_VARIABLE, "")
    monkeypatch.delenv(llvm.PROBE_VARIABLE)


def _children_run(monkeypatch, code):
    monkeypatch.setattr(llvm, "_CHILD", code)
    monkeypatch.setattr(llvm, "cuda_may_work", lambda: False)


def _forbid_children(monkeypatch):
    def run(*_args, **_kwargs):
        raise AssertionError("probed again")

    monkeypatch.setattr(subprocess, "run", run)


def test_candidates_are_newest_first_and_each_file_once(tmp_path, monkeypatch):
    for name in ("libLLVM-9.so.1", "libLLVM.so.19.1", "libLLVM-15.so.1"):
        (tmp_path / name).touch()
    (tmp_path / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    monkeypatch.delenv(llvm.LIBRARY_VARIABLE, raising=False)
    monkeypatch.setattr(llvm, "_FOLDERS", (str(tmp_path),))
    versions = [llvm.libllvm_version(path) for path in llvm.libllvm_candidates()]
    assert versions == [(19, 1), (15,), (9,)]


def test_explicit_variant_that_cannot_run_names_the_package(monkeypatch):
    monkeypatch.setenv(llvm.LIBRARY_VARIABLE, "/nowhere/libLLVM-14.so.1")
    _children_run(
        monkeypatch,
        "import os, sys; print('LLVM ERROR: Cannot select: fmaximum', file=sys.stderr); os.abort()",
    )
    with pytest.raises(RenderError, match=r"libLLVM-14.*fmaximum.*libllvm19"):
        llvm.find_variant("llvm_ad_mono")


def test_auto_falls_back_to_scalar(monkeypatch):
    monkeypatch.setenv(llvm.LIBRARY_VARIABLE, "/nowhere/libLLVM-14.so.1")
    _children_run(monkeypatch, "import os; os.abort()")
    assert llvm.find_variant().variant == "scalar_rgb"
    _forbid_children(monkeypatch)  # the fall back is remembered, too
    assert llvm.find_variant().variant == "scalar_rgb"


def test_library_that_does_not_work_is_passed_over(tmp_path, monkeypatch):
    for name in ("libLLVM.so.19.1", "libLLVM-16.so.1"):
        (tmp_path / name).touch()
    monkeypatch.delenv(llvm.LIBRARY_VARIABLE, raising=False)
    monkeypatch.setattr(llvm, "_FOLDERS", (str(tmp_path),))
    _children_run(
        monkeypatch,
        f"import os; '.so.19' in os.environ['{llvm.LIBRARY_VARIABLE}'] and os.abort()\n"
        f"print('{llvm._CHILD_OK}')",
    )
    assert llvm.find_variant().llvm_path == str(tmp_path / "libLLVM-16.so.1")


def test_answer_is_inherited_through_the_environment(tmp_path, monkeypatch):
    library = tmp_path / "libLLVM.so.19.1"
    library.touch()
    monkeypatch.delenv(llvm.LIBRARY_VARIABLE, raising=False)
    answer = {"variant": "llvm_ad_mono", "llvm_path": str(library)}
    monkeypatch.setenv(llvm.PROBE_VARIABLE, json.dumps(answer))
    _forbid_children(monkeypatch)
    assert llvm.find_variant() == llvm.Probe(**answer)


def test_stale_answer_is_not_believed(monkeypatch):
    monkeypatch.setenv(llvm.PROBE_VARIABLE, '{"variant": "llvm_ad_mono", "llvm_path": "/gone"}')
    monkeypatch.setenv(llvm.LIBRARY_VARIABLE, "/nowhere/libLLVM.so.19.1")
    _children_run(monkeypatch, f"print('{llvm._CHILD_OK}')")
    assert llvm.find_variant().llvm_path == "/nowhere/libLLVM.so.19.1"
    assert "/nowhere" in os.environ[llvm.PROBE_VARIABLE]
