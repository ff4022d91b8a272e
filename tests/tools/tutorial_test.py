"""Runs the commands of docs/tutorial.md in their order, as they stand there but for ports and sizes.

  tutorial_test.py BIN [--full]

--full: with the sizes of the page, and what the programs say.
"""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time

PROJECT = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))
# What the page promises.
IMAGES = ["look.exr", "dusk.exr", "farm.exr", "above.exr", "alone.exr", "tls.exr",
          "look.png", "dusk.png", "farm.png", "above.png"]


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def script_of(page, full):
    """The page's commands, one script."""
    blocks = re.findall(r"```sh\n(.*?)```", page, re.S)
    if len(blocks) < 8:
        sys.exit("tutorial_test: docs/tutorial.md has lost its commands")
    script = "trap 'kill $(jobs -p) 2>/dev/null || true' EXIT\n" + "".join(f"echo '== block {i}' >&2\n{block}" for i, block in enumerate(blocks, 1))
    for port in sorted(set(re.findall(r"\b(?:127\.0\.0\.1|localhost):(\d+)\b", script))):
        script = script.replace(":" + port, f":{free_port()}")
    if not full:
        script = re.sub(r"--resolution (?:640x360|320x180)", "--resolution 64x36", script)
    return script


def main():
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    full = "--full" in sys.argv
    with open(os.path.join(PROJECT, "docs", "tutorial.md"), encoding="utf-8") as file:
        script = script_of(file.read(), full)
    folder = tempfile.mkdtemp(prefix="farpoint-tutorial-")
    os.makedirs(os.path.join(folder, "build", "release"))
    os.symlink(os.path.abspath(sys.argv[1]), os.path.join(folder, "build", "release", "bin"))
    os.symlink(os.path.join(PROJECT, "scenes"), os.path.join(folder, "scenes"))
    # `jobs -p` of a script names its background processes, as it does in a terminal.
    start = time.monotonic()
    process = subprocess.Popen(["bash", "-euo", "pipefail", "-c", script], cwd=folder,
                               stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                               start_new_session=True,
                               env={k: v for k, v in os.environ.items()
                                    if not k.startswith("FARPOINT_")})
    try:
        said, _ = process.communicate(timeout=3600 if full else 280)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        said, _ = process.communicate()
        said += "\ntutorial_test: took too long"
    missing = [name for name in IMAGES
               if not os.path.exists(os.path.join(folder, "tutorial", name))]
    good = process.returncode == 0 and not missing and \
        len(re.findall(r"hash +equal", said)) == 2
    if full or not good:
        print(said)
        for name in sorted(os.listdir(os.path.join(folder, "tutorial"))):
            if name.endswith(".log") and not good:
                with open(os.path.join(folder, "tutorial", name), encoding="utf-8") as file:
                    print(f"-- {name}\n{file.read()}")
    print(f"tutorial_test: exit code {process.returncode}, missing {missing}, "
          f"{time.monotonic() - start:.0f} s")
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        pass
    shutil.rmtree(folder)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
