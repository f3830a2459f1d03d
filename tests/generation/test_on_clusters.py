"""generate.py on a cluster of Ray with three nodes, whose parts are killed; and on array jobs."""

from __future__ import annotations

import functools
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from qs3.errors import DataError, MeshError, RenderError
from qs3.generation.command import generate
from qs3.generation.workers import Job, _sent, check_software, save_part, scan_all, software
from qs3.meshes.folder import MeshFolder
from qs3.meshes.mesh import MeshItem
from qs3.store.parts import PartFiles
from qs3.utils.pool import Processes
from tests.generation.generating import QUICK, ROOT, config, fingerprint

slow = pytest.mark.slow
SCANS = ["scans=5", "classes=[chair,table,lamp]", "renderer.samples=1"]


class Nodes:
    """Three nodes of Ray on this machine, each with one core."""

    def __init__(self):
        from ray.cluster_utils import Cluster

        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        small = {"num_cpus": 1, "object_store_memory": 100 * 2**20}
        head = {**small, "include_dashboard": False}
        self.cluster = Cluster(initialize_head=True, head_node_args=head)
        self.others = [self.cluster.add_node(**small) for _ in range(2)]

    def kill_one(self, process):
        """One that is scanning, with its worker, which is held first: it cannot end just before."""
        raylets = [node.all_processes["raylet"][0].process.pid for node in self.others]
        worker = held_at_work(process, raylets)
        node = self.others.pop(raylets.index(parent(worker)))
        self.cluster.remove_node(node, allow_graceful=False)
        os.kill(worker, signal.SIGKILL)  # being held it does not see that its node is gone


@pytest.fixture
def nodes():
    found = Nodes()
    yield found
    found.cluster.shutdown()


def at_work():
    """Processes of Ray that are scanning now."""
    pids = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if path.read_bytes().startswith(b"ray::_do"):
                pids.append(int(path.parent.name))
        except OSError:
            continue
    return pids


def parent(pid):
    return int(Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[1])


def held_at_work(process, parents=()):
    """Stops a process that is scanning, a child of one of `parents` if there are any."""
    found = []

    def hold():
        for pid in at_work():
            if parents and parent(pid) not in parents:
                continue
            os.kill(pid, signal.SIGSTOP)
            if pid in at_work():
                found.append(pid)
                return True
            os.kill(pid, signal.SIGCONT)
        return False

    wait_for(hold, process, "one was held at its work")
    return found[0]


def start(folder, meshes, *words):
    command = [
        sys.executable, "generate.py", "domain=specklenet10", *QUICK[:-1], *SCANS,
        f"meshes={meshes}", f"paths.data_dir={folder}", "up=z", *words,
    ]  # fmt: skip
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen(command, cwd=ROOT, start_new_session=True, **pipes)


def wait_for(condition, process, what):
    end = time.monotonic() + 240
    while not condition():
        if process.poll() is not None:
            pytest.fail(f"it ended before {what}:\n{process.stdout.read()}")
        assert time.monotonic() < end, what
        time.sleep(0.1)


def scanned(folder):
    return len(list((folder / "specklenet10" / "parts").glob("*.npz")))


def ended(process):
    said = process.communicate(timeout=400)[0]
    assert process.returncode == 0, said
    return said


@pytest.fixture(scope="module")
def whole(meshes, tmp_path_factory):
    """What one process of this machine makes of it."""
    folder = tmp_path_factory.mktemp("whole")
    generate(config(folder, meshes, *SCANS, "up=z", "workers=0"))
    return fingerprint(folder / "specklenet10")


@slow
@pytest.mark.parametrize("shared", ["true", "false"])
def test_a_node_and_a_worker_are_killed(nodes, meshes, whole, tmp_path, shared):
    """With meshes that all nodes see, and with meshes that are sent to them."""
    process = start(
        tmp_path, meshes, "engine=ray", f"engine.address={nodes.cluster.address}",
        f"engine.shared_disk={shared}",
    )  # fmt: skip
    wait_for(lambda: scanned(tmp_path) >= 3, process, "three objects were done")
    nodes.kill_one(process)
    done = scanned(tmp_path)
    wait_for(lambda: scanned(tmp_path) > done, process, "more were done")
    os.kill(held_at_work(process), signal.SIGKILL)
    said = ended(process)
    assert "Ray: 3 nodes, 3 cores" in said
    assert said.count(": its process or node is gone (") >= 2, said
    assert fingerprint(tmp_path / "specklenet10") == whole


@slow
def test_the_driver_is_killed_and_goes_on(nodes, meshes, whole, tmp_path):
    words = ("engine=ray", f"engine.address={nodes.cluster.address}")
    process = start(tmp_path, meshes, *words)
    wait_for(lambda: scanned(tmp_path) >= 5, process, "five objects were done")
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    done = scanned(tmp_path)
    assert 5 <= done < 45
    process = start(tmp_path, meshes, *words)
    said = ended(process)
    assert "continuing: " in said
    assert fingerprint(tmp_path / "specklenet10") == whole


@slow
def test_array_jobs_make_the_same(meshes, whole, tmp_path):
    """SLURM's array jobs, by the processes with which submitit stands in for them."""
    words = ("cluster=local", "jobs=2", "tasks_per_job=10", "poll_s=0.5")
    process = start(tmp_path, meshes, "engine=slurm", *(f"engine.{word}" for word in words))
    ended(process)
    assert fingerprint(tmp_path / "specklenet10") == whole


def test_other_software_is_refused():
    here = {**software(), "variant": "llvm_ad_mono"}
    check_software(here, here)
    assert {"numpy", "mitsuba", "python", "qs3's code"} <= set(here)
    with pytest.raises(RenderError, match="numpy"):
        check_software({**here, "numpy": "0.1"}, here)
    with pytest.raises(RenderError, match="variant"):
        check_software(here, {**here, "variant": "cuda_ad_mono"})


def test_a_node_that_does_not_see_the_folder_is_refused(tmp_path):
    """What it saved on a disk of its own would be lost."""
    parts = PartFiles(tmp_path / "specklenet10")
    (tmp_path / "specklenet10").mkdir()
    parts.begin({"settings": 1})
    check = pickle.loads(pickle.dumps(functools.partial(parts.check_there, parts.recipe_sha256())))
    check()
    job = Job(Recipe(), object, 0, save=functools.partial(save_part, parts), check_place=check)
    item = MeshItem("chair/train/a", "chair", "train", object, "a")
    parts.clear()
    shutil.rmtree(tmp_path / "specklenet10")
    with pytest.raises(DataError):
        next(scan_all(job, [item], Processes(1)))
    assert not (tmp_path / "specklenet10").exists()
    (tmp_path / "specklenet10").mkdir()
    parts.begin({"settings": 2})
    with pytest.raises(DataError):
        check()


@dataclass(frozen=True)
class Recipe:
    needs_renderer: bool = False


def items_of(root):
    return MeshFolder(root, classes=("chair",)).items()


def test_meshes_travel_without_their_disk(meshes, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(meshes, copy)
    (copy / "chair" / "train" / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\nelement")
    items = items_of(copy)
    expected = [item.load() for item in items if "broken" not in item.id]
    with pytest.raises(MeshError) as here:
        next(item for item in items if "broken" in item.id).load()
    messages = [pickle.dumps(item) for item in _sent(items, keep_views=False)]
    shutil.rmtree(copy)
    arrived = [pickle.loads(message) for message in messages]
    whole = [item for item in arrived if "broken" not in item.id]
    assert [item.load().sha256 for item in whole] == [mesh.sha256 for mesh in expected]
    with pytest.raises(MeshError) as there:
        next(item for item in arrived if "broken" in item.id).load()
    assert str(there.value) == str(here.value)  # and not where the copy lay
