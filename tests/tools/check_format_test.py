"""tools/check_format in a repository of its own."""

import os
import shutil
import subprocess
import unittest

from tool_test import PROJECT, TreeTest


class CheckFormat(TreeTest):
    def setUp(self):
        super().setUp()
        for path in (".clang-format", "tools/check_format"):
            os.makedirs(os.path.join(self.root, os.path.dirname(path)), exist_ok=True)
            shutil.copy(os.path.join(PROJECT, path), os.path.join(self.root, path))
        subprocess.run(["git", "init", "-q", self.root], check=True)

    def run_tool(self, *arguments):
        subprocess.run(["git", "-C", self.root, "add", "."], check=True)
        done = subprocess.run([os.path.join(self.root, "tools", "check_format"), *arguments],
                              capture_output=True, text=True, timeout=60)
        return done.returncode, done.stderr

    def test_a_formatted_tree_passes(self):
        self.write("core/a.cc", "int a = 0;\n")
        self.assertEqual((0, ""), self.run_tool())

    def test_a_difference_is_reported_where_it_is_and_can_be_mended(self):
        self.write("core/good.cc", "int a = 0;\n")
        self.write("core/a name.cc", "int a = 0;\nint  b=1;\n")
        code, err = self.run_tool()
        self.assertEqual(1, code)
        self.assertIn("core/a name.cc:2:", err)
        self.assertNotIn("good.cc", err)
        self.assertEqual((0, ""), self.run_tool("--fix"))
        self.assertEqual((0, ""), self.run_tool())

    def test_a_tree_without_sources_passes(self):
        self.assertEqual((0, ""), self.run_tool())

    def test_an_unknown_argument_is_refused(self):
        self.assertEqual(2, self.run_tool("--fixx")[0])


if __name__ == "__main__":
    unittest.main()
