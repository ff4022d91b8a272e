"""What the tests of the tools share: a tree made of strings, and a tool run on it."""

import os
import subprocess
import sys
import tempfile
import unittest

PROJECT = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))


class TreeTest(unittest.TestCase):
    """A fresh folder per test."""

    def setUp(self):
        self._folder = tempfile.TemporaryDirectory(prefix="farpoint-tools-")
        self.addCleanup(self._folder.cleanup)
        self.root = self._folder.name

    def write(self, path, text, executable=False):
        absolute = os.path.join(self.root, path)
        os.makedirs(os.path.dirname(absolute), exist_ok=True)
        with open(absolute, "w", encoding="utf-8") as file:
            file.write(text)
        if executable:
            os.chmod(absolute, 0o755)
        return absolute

    def check(self, tool, files):
        """The (exit code, [lines of output]) of the checker on a tree of {path: text}."""
        for path, text in files.items():
            self.write(path, text)
        done = subprocess.run(
            [sys.executable, os.path.join(PROJECT, "tools", tool), "--root", self.root],
            capture_output=True, text=True, timeout=60)
        self.assertEqual("", done.stderr)
        return done.returncode, done.stdout.splitlines()
