"""tools/make_manual on programs that are scripts which print a help."""

import os
import re
import subprocess
import sys
import unittest

from tool_test import PROJECT, TreeTest

OVERVIEW = """farpoint renders.

  farpoint render SCENE -o OUT.exr [flags]
  farpoint pause | resume JOB...
  farpoint certs init | add [NAME]   what certs does
"""
RENDER = """farpoint render SCENE [flags]
render a scene

  SCENE                     a scene's file

Output:
  -o, --output OUT.exr      the image
  --a-flag-with-a-long-name X
                            told on the next line, \\n and
                            the one after
General:
  --quiet                   say nothing
"""
OTHER = "farpoint {verb} JOB [flags]\n{verb} jobs\n\n  JOB                       ids of jobs\n\nGeneral:\n" \
        "  --quiet                   say nothing\n"
SERVICE = """{name}: serves.
Usage: ./{name} [OPTIONS]

Options:
  -h,--help                   Print this help message and exit
  --store TEXT REQUIRED       Folder for jobs
  --log-format TEXT:{{text,json}}=text
                              How the log is written
  --silence-ms UINT:UINT in [50 - 4611686018427387904]=4000
                              Silence
  --share FLOAT:FLOAT in [0 - 1]=0.02
                              Share
  --name TEXT=host.example:17 Shown
"""


class MakeManual(TreeTest):
    def setUp(self):
        super().setUp()
        self.own = {"": OVERVIEW, "render": RENDER,
                    **{verb: OTHER.format(verb=verb) for verb in ("pause", "resume", "certs")}}
        self.services = {name: SERVICE.format(name=name)
                         for name in ("farpoint-server", "farpoint-worker", "farpoint-health")}

    def make(self, values=None):
        """(exit code, stderr). `values`: VALUES of the tool, instead of its own."""
        cases = "".join(f"{verb or '--help'}) cat <<'END'\n{text}END\n;;\n"
                        for verb, text in self.own.items())
        self.write("bin/farpoint", f"#!/bin/bash\ncase $1 in\n{cases}esac\n", executable=True)
        for name, text in self.services.items():
            self.write(f"bin/{name}", f"#!/bin/bash\ncat <<'END'\n{text}END\n", executable=True)
        with open(os.path.join(PROJECT, "tools", "make_manual"), encoding="utf-8") as file:
            tool = re.sub(r"^VALUES = \{.*?^\}", f"VALUES = {values or {}!r}", file.read(),
                          flags=re.M | re.S)
        self.write("make_manual", tool)
        done = subprocess.run(
            [sys.executable, os.path.join(self.root, "make_manual"), "--bin",
             os.path.join(self.root, "bin"), "--out", os.path.join(self.root, "out"), "--version", "1.2"],
            capture_output=True, text=True, timeout=60, check=False)
        return done.returncode, done.stderr

    def read(self, path):
        with open(os.path.join(self.root, "out", path), encoding="utf-8") as file:
            return file.read()

    def test_a_page_for_each_command_and_program(self):
        self.assertEqual((0, ""), self.make())
        self.assertEqual(
            ["farpoint-certs.1", "farpoint-health.1", "farpoint-pause.1", "farpoint-render.1",
             "farpoint-resume.1", "farpoint-server.1", "farpoint-worker.1", "farpoint.1"],
            sorted(os.listdir(os.path.join(self.root, "out", "man1"))))
        self.assertIn('"farpoint 1.2"', self.read("man1/farpoint.1"))

    def test_wrapped_help_is_one_text_and_backslashes_stay(self):
        self.make()
        self.assertIn("\\fB\\-\\-a\\-flag\\-with\\-a\\-long\\-name\\fR \\fIX\\fR\n"
                      "told on the next line, \\en and the one after.\n",
                      self.read("man1/farpoint-render.1"))

    def test_types_of_the_services_flags_become_words(self):
        self.make()
        page = self.read("man1/farpoint-server.1").replace("\\-", "-")
        self.assertIn("\\fB--store\\fR \\fITEXT\\fR\nFolder for jobs.\nRequired.", page)
        self.assertIn("One of \\fBtext\\fR, \\fBjson\\fR.\nDefault: text.", page)
        self.assertIn("Silence (from 50).\nDefault: 4000.", page)
        self.assertIn("Share (0 to 1).\nDefault: 0.02.", page)

    def test_defaults_may_stand_in_brackets_as_newer_versions_of_cli11_write_them(self):
        self.assertEqual((0, ""), self.make())
        before = self.read("man1/farpoint-server.1")
        self.services["farpoint-server"] = re.sub(
            r"=(4000|text|0\.02)$", r" [\1] ", self.services["farpoint-server"], flags=re.M)
        self.assertIn("[4000] \n", self.services["farpoint-server"])
        self.assertEqual((0, ""), self.make())
        self.assertEqual(before, self.read("man1/farpoint-server.1"))

    def test_defaults_of_the_machine_are_left_out(self):
        self.make()
        page = self.read("man1/farpoint-worker.1")
        self.assertIn("Default: HOST:PID.", page)
        self.assertNotIn("host.example", page)

    def test_values_must_stand_in_the_help(self):
        self.own["render"] += "  --quality LEVEL           draft or fine (the default)\n"
        self.assertEqual((0, ""), self.make({"--quality": "draft fine"}))
        self.assertIn('compgen -W "draft fine"', self.read("bash/farpoint"))
        code, error = self.make({"--quality": "draft perfect"})
        self.assertEqual(1, code)
        self.assertIn("'perfect' for --quality, which the help of farpoint-render does not name", error)
        code, error = self.make({"--beauty": "much"})
        self.assertEqual(1, code)
        self.assertIn("--beauty, which no program takes", error)

    def test_a_help_that_cannot_be_read_is_an_error(self):
        self.own["render"] += "   --odd\n"
        code, error = self.make()
        self.assertEqual(1, code)
        self.assertIn("cannot read the line '   --odd'", error)

    def test_a_program_that_fails_is_an_error(self):
        self.services["farpoint-worker"] = "END\nexit 3\ncat <<'END'\n"
        code, error = self.make()
        self.assertEqual(1, code)
        self.assertIn("farpoint-worker --help ended with 3", error)


if __name__ == "__main__":
    unittest.main()
