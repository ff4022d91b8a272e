"""./dev on a machine made of stand-ins: its own PATH, in which apt-get, cmake and the programs that
a build would leave only record how they were called."""

import os
import shutil
import signal
import subprocess
import time
import unittest

from tool_test import PROJECT, TreeTest

REAL = ["basename", "bash", "cat", "comm", "dirname", "env", "mkdir", "mktemp", "nproc", "rm", "sed",
        "setpriv", "sleep", "sort", "tail", "python3"]
RECORD = '#!/bin/bash\necho "${0##*/} $*" >>"$RECORD"\n'

SERVER = RECORD + """
while [[ $1 != --port-file ]]; do shift; done
echo 4711 >"$2"
echo $$ >>"$PIDS"
exec sleep 600
"""
WORKER = RECORD + 'echo $$ >>"$PIDS"\nexec sleep 600\n'
CLIENT = RECORD + """
if [[ $1 == status ]]; then
  while [[ $1 != --json ]]; do shift; done
  echo '{"jobs": [], "workers": [{}, {}]}' >"$2"
  exit 0
fi
echo $$ >>"$PIDS"
$SUBMIT
"""


def is_alive(pid):
    try:
        with open(f"/proc/{pid}/stat", encoding="ascii") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


class Dev(TreeTest):
    def setUp(self):
        super().setUp()
        shutil.copy(os.path.join(PROJECT, "dev"), self.root)
        self.write("tools/packages.txt", "# comment\nninja-build\n\nlibfoo-dev   # why\n")
        os.makedirs(os.path.join(self.root, "path"))
        for name in REAL:
            os.symlink(shutil.which(name), os.path.join(self.root, "path", name))
        for name in ("cmake", "ctest", "apt-get"):
            self.fake(name, RECORD)
        self.installed("ninja-build", "libfoo-dev")
        self.fake("id", "#!/bin/bash\necho 0\n")
        for name, text in (("farpoint-server", SERVER), ("farpoint-worker", WORKER),
                           ("farpoint", CLIENT), ("farpoint-bench", RECORD)):
            self.write(f"build/release/bin/{name}", text, executable=True)

    def fake(self, name, text):
        self.write(f"path/{name}", text, executable=True)

    def installed(self, *names):
        lines = "".join(f"installed {name}\\n" for name in names)
        self.fake("dpkg-query", f"#!/bin/bash\nprintf '{lines}'\n")

    def start(self, *arguments, submit="true", **environment):
        return subprocess.Popen(
            [os.path.join(self.root, "dev"), *arguments], stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env={"PATH": os.path.join(self.root, "path"), "SUBMIT": submit, **environment,
                 "RECORD": os.path.join(self.root, "record"),
                 "PIDS": os.path.join(self.root, "pids"), "TMPDIR": self.root})

    def run_dev(self, *arguments, **options):
        """(exit code, stdout, stderr, [recorded calls])."""
        process = self.start(*arguments, **options)
        out, err = process.communicate(timeout=60)
        return process.returncode, out, err, self.lines("record")

    def lines(self, name):
        try:
            with open(os.path.join(self.root, name), encoding="utf-8") as file:
                return file.read().splitlines()
        except FileNotFoundError:
            return []

    def assert_demo_left_nothing(self, processes):
        pids = self.lines("pids")
        self.assertEqual(processes, len(pids))
        deadline = time.monotonic() + 10
        while any(is_alive(pid) for pid in pids) and time.monotonic() < deadline:
            time.sleep(0.05)
        self.assertEqual([], [pid for pid in pids if is_alive(pid)])
        self.assertEqual([], [name for name in os.listdir(self.root) if name.startswith("tmp.")])

    def test_help_names_every_command(self):
        code, out, _, _ = self.run_dev("--help")
        self.assertEqual(0, code)
        for command in ("build", "demo", "test", "asan", "tsan", "fuzz", "bench", "format"):
            self.assertIn(f"\n  {command} ", out)

    def test_unknown_commands_are_a_usage_error(self):
        for arguments in ((), ("biuld",)):
            code, out, err, calls = self.run_dev(*arguments)
            self.assertEqual((2, "", []), (code, out, calls))
            self.assertIn("usage:", err)

    def test_nothing_is_installed_where_all_is_there(self):
        code, _, _, calls = self.run_dev("build", CMAKE_BUILD_PARALLEL_LEVEL="3")
        self.assertEqual(0, code)
        self.assertEqual(["cmake --preset release",
                          "cmake --build --preset release --parallel 3"], calls)

    def test_what_is_missing_is_installed_without_an_update(self):
        self.installed("ninja-build")
        code, _, _, calls = self.run_dev("build", "debug")
        self.assertEqual(0, code)
        install = ("apt-get -q -y -o DPkg::Lock::Timeout=300 install --no-install-recommends "
                   "libfoo-dev")
        self.assertEqual([install + " --dry-run", install, "cmake --preset debug"], calls[:3])

    def test_package_lists_are_fetched_where_they_do_not_know_a_package(self):
        self.installed("ninja-build")
        self.fake("apt-get", RECORD + '[[ $* == *update* ]] && touch "$RECORD.updated"\n'
                                      '[[ -e $RECORD.updated ]]\n')
        os.symlink(shutil.which("touch"), os.path.join(self.root, "path", "touch"))
        code, _, _, calls = self.run_dev("build")
        self.assertEqual(0, code)
        self.assertEqual(["install", "update", "install"],
                         [call.split()[5] for call in calls if call.startswith("apt-get")])

    def test_sudo_is_used_where_it_is_needed_and_there(self):
        self.installed("ninja-build")
        self.fake("id", "#!/bin/bash\necho 1000\n")
        self.fake("sudo", RECORD)
        code, _, _, calls = self.run_dev("build")
        self.assertEqual(0, code)
        self.assertEqual("sudo env DEBIAN_FRONTEND=noninteractive apt-get",
                         " ".join(calls[1].split()[:4]))

    def test_without_root_and_sudo_the_cure_is_named(self):
        self.installed()
        self.fake("id", "#!/bin/bash\necho 1000\n")
        code, _, err, calls = self.run_dev("test")
        self.assertEqual((1, []), (code, calls))
        self.assertIn("apt-get install --no-install-recommends libfoo-dev ninja-build", err)

    def test_an_install_that_fails_is_an_error(self):
        self.installed()
        self.fake("apt-get", "#!/bin/bash\nexit 100\n")
        code, _, err, calls = self.run_dev("build")
        self.assertEqual((1, []), (code, calls))
        self.assertIn("apt-get update failed", err)

    def test_test_hands_its_arguments_and_exit_code_on(self):
        self.fake("ctest", RECORD + "exit 8\n")
        code, _, _, calls = self.run_dev("test", "-R", "core_base")
        self.assertEqual((8, "ctest --preset release -R core_base"), (code, calls[-1]))

    def test_bench_hands_its_arguments_on(self):
        code, _, _, calls = self.run_dev("bench", "micro", "--quick")
        self.assertEqual((0, "farpoint-bench micro --quick"), (code, calls[-1]))
        self.assertTrue(calls[1].endswith(" --target farpoint-bench"), calls[1])

    def test_demo_renders_the_citys_image_with_two_workers(self):
        code, out, err, calls = self.run_dev("demo")
        self.assertEqual(0, code, err)
        self.assertTrue(calls[1].endswith(" --target farpoint farpoint-server farpoint-worker"))
        self.assertEqual(2, sum(call.startswith("farpoint-worker --coordinator 127.0.0.1:4711 ")
                                for call in calls))
        self.assertTrue(calls[-1].startswith(
            "farpoint submit scenes/city.glb --resolution 1280x1000 --coordinator 127.0.0.1:4711 "
            "-o out/demo.exr --png out/demo.png"), calls[-1])
        self.assertIn("out/demo.exr", out)
        self.assert_demo_left_nothing(processes=4)

    def test_demo_takes_sponza_where_it_is(self):
        sponza = self.write("scenes of mine/sponza/Sponza.gltf", "{}")
        code, _, err, calls = self.run_dev(
            "demo", FARPOINT_SCENES=os.path.join(self.root, "scenes of mine"))
        self.assertEqual(0, code, err)
        self.assertIn(f"submit {sponza} --eye 9,0.8,-0.3 --target -8,4,-0.3 --fov 57", calls[-1])

    def test_demo_leaves_nothing_when_the_render_fails(self):
        code, _, err, _ = self.run_dev("demo", submit="exit 75")
        self.assertEqual(1, code)
        self.assertIn("exit code 75", err)
        self.assertIn("coordinator.log", err)
        self.assert_demo_left_nothing(processes=4)

    def test_demo_says_so_when_a_process_ends_early(self):
        self.write("build/release/bin/farpoint-server", "#!/bin/bash\necho no such luck >&2\n",
                   executable=True)
        code, _, err, _ = self.run_dev("demo")
        self.assertEqual(1, code)
        self.assertIn("no such luck", err)
        self.assertIn("a process ended", err)

    def wait_for_submit(self):
        deadline = time.monotonic() + 30
        while len(self.lines("pids")) < 4:
            self.assertLess(time.monotonic(), deadline)
            time.sleep(0.05)

    def test_demo_leaves_nothing_after_a_signal(self):
        process = self.start("demo", submit="exec sleep 600")
        self.wait_for_submit()
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=30)
        self.assertEqual(143, process.returncode)
        self.assert_demo_left_nothing(processes=4)

    def test_demo_leaves_no_process_when_it_is_killed(self):
        process = self.start("demo", submit="exec sleep 600")
        self.wait_for_submit()
        process.kill()
        process.communicate(timeout=30)
        deadline = time.monotonic() + 10
        pids = self.lines("pids")
        while any(is_alive(pid) for pid in pids) and time.monotonic() < deadline:
            time.sleep(0.05)
        self.assertEqual([], [pid for pid in pids if is_alive(pid)])


if __name__ == "__main__":
    unittest.main()
