"""Run a notebook by this interpreter.

    python tests/run_notebook.py IN.ipynb OUT.ipynb WORKING_FOLDER SCRATCH_FOLDER

A process of its own, because jupyter_client leaves sockets for the garbage collector, and in the
tests each of them would be an error.
"""

from __future__ import annotations

import sys
from pathlib import Path

import nbformat
from jupyter_client.kernelspec import KernelSpec
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient


class ThisPython(AsyncKernelManager):
    """Starts kernels by the interpreter that runs this, whatever kernels are installed."""

    @property
    def kernel_spec(self) -> KernelSpec:
        argv = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
        return KernelSpec(argv=argv, display_name="this Python", language="python")


def main(source: str, target: str, folder: str, scratch: str) -> None:
    notebook = nbformat.read(source, as_version=4)
    # Sockets in files: no port, and nothing that others on the machine or network could reach.
    manager = ThisPython(
        transport="ipc",
        ip=str(Path(scratch, "socket")),
        connection_file=str(Path(scratch, "kernel.json")),
    )
    where = {"metadata": {"path": folder}}
    NotebookClient(notebook, km=manager, timeout=300, resources=where).execute()
    nbformat.write(notebook, target)


if __name__ == "__main__":
    main(*sys.argv[1:])
