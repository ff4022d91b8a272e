"""docker/slurm's job scripts without Slurm: its variables set, the programs stand-ins that record how
they were called and end at SIGTERM."""

import os
import signal
import subprocess
import time
import unittest

from tool_test import PROJECT, TreeTest

# Also when the signal comes before the trap would.
PROGRAM = """#!/usr/bin/env python3
import os, signal, sys
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
with open(os.environ["RECORD"], "a") as file:
    file.write(" ".join([os.path.basename(sys.argv[0])] + sys.argv[1:]) + "\\n")
if "--port-file" in sys.argv:
    with open(sys.argv[sys.argv.index("--port-file") + 1], "w") as file:
        file.write("4711")
if os.environ.get("FAILS"):
    sys.exit(42)
signal.sigwait([signal.SIGTERM])
with open(os.environ["RECORD"], "a") as file:
    file.write("drained\\n")
"""


class SlurmScripts(TreeTest):
    def setUp(self):
        super().setUp()
        for name in ("farpoint-server", "farpoint-worker"):
            self.write(f"bin/{name}", PROGRAM, executable=True)
        self.farm = os.path.join(self.root, "farm")
        self.processes = []
        self.addCleanup(self.end_all)

    def end_all(self):
        for process in self.processes:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    def start(self, script, *arguments, **environment):
        process = subprocess.Popen(
            ["bash", os.path.join(PROJECT, "docker", "slurm", script), *arguments],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            start_new_session=True, cwd=self.root,
            env={"PATH": os.path.join(self.root, "bin") + os.pathsep + os.environ["PATH"],
                 "SLURM_JOB_ID": "17", "SLURM_ARRAY_JOB_ID": "16", "SLURM_ARRAY_TASK_ID": "3",
                 "SLURM_CPUS_PER_TASK": "5", "SLURMD_NODENAME": "node8",
                 "SLURM_SUBMIT_DIR": self.root, "FARPOINT_CACHE": os.path.join(self.root, "cache"),
                 "RECORD": os.path.join(self.root, "record"), **environment})
        self.processes.append(process)
        return process

    def record(self):
        try:
            with open(os.path.join(self.root, "record"), encoding="utf-8") as file:
                return file.read().splitlines()
        except FileNotFoundError:
            return []

    def wait_until(self, condition):
        deadline = time.monotonic() + 60
        while not condition():
            self.assertLess(time.monotonic(), deadline, self.record())
            time.sleep(0.02)

    def test_the_coordinator_says_where_it_is_and_gets_the_signals_itself(self):
        os.makedirs(os.path.join(self.farm, "certs"))
        process = self.start("coordinator.sbatch", "--web", "127.0.0.1:7480")
        address = os.path.join(self.farm, "address")
        self.wait_until(lambda: os.path.exists(address))
        with open(address, encoding="utf-8") as file:
            self.assertRegex(file.read(), r"^[\w.-]+:4711\n$")
        self.assertEqual(
            [f"farpoint-server --listen 0.0.0.0:0 --port-file {self.farm}/port.17 --store "
             f"{self.farm}/store --threads 5 --certs {self.farm}/certs --web 127.0.0.1:7480"],
            self.record())
        # To one process only, as Slurm signals a batch step's shell.
        os.kill(process.pid, signal.SIGTERM)
        self.assertEqual(0, process.wait(60))
        self.assertEqual("drained", self.record()[-1])

    def test_a_worker_waits_for_the_coordinator_and_drains(self):
        process = self.start("workers.sbatch", "--log-format", "json")
        self.assertIsNone(process.poll())
        self.write("farm/address", "head1:4711\n")
        self.wait_until(self.record)
        self.assertEqual(
            [f"farpoint-worker --coordinator head1:4711 --cache {self.root}/cache --name node8:16_3 "
             "--threads 5 --insecure --log-format json"], self.record())
        os.kill(process.pid, signal.SIGTERM)
        self.assertEqual(0, process.wait(60))
        self.assertEqual("drained", self.record()[-1])

    def test_a_worker_follows_a_coordinator_that_moved(self):
        self.write("farm/address", "head1:4711\n")
        process = self.start("workers.sbatch")
        self.wait_until(self.record)
        self.write("farm/address.new", "head2:4712\n")
        os.rename(os.path.join(self.farm, "address.new"), os.path.join(self.farm, "address"))
        self.wait_until(lambda: len(self.record()) == 3)
        self.assertEqual("drained", self.record()[1])
        self.assertIn("--coordinator head2:4712 ", self.record()[2])
        os.kill(process.pid, signal.SIGTERM)
        self.assertEqual(0, process.wait(60))

    def test_a_worker_stopped_before_there_is_a_coordinator_ends(self):
        process = self.start("workers.sbatch")
        cache = os.path.join(self.root, "cache")
        self.wait_until(lambda: os.path.isdir(cache))
        os.kill(process.pid, signal.SIGTERM)
        self.assertEqual(0, process.wait(60))
        self.assertEqual([], self.record())

    def test_a_worker_that_fails_by_itself_fails_the_job(self):
        self.write("farm/address", "head1:4711\n")
        process = self.start("workers.sbatch", FAILS="1")
        self.assertEqual(42, process.wait(60))
        self.assertEqual(1, len(self.record()))


if __name__ == "__main__":
    unittest.main()
