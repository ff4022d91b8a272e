"""Commands that the pages show are commands that the programs take: every flag of a `farpoint…` line in
a code block is in that program's --help, and no line goes on by two backslashes.

  shown_commands_test.py BIN
"""

import os
import re
import subprocess
import sys
import unittest

from tool_test import PROJECT

sys.path.insert(0, os.path.join(PROJECT, "tools"))
sys.dont_write_bytecode = True
import source_tree  # noqa: E402

BIN = None
# A program, after variables, `x=$(` and a folder.
_PROGRAM = re.compile(r"(?:\w+=(?:\$\(|\S*\s+))*(?:[\w./]*/)?"
                      r"(farpoint(?:-server|-worker|-health)?)(?=\s|$)(.*)")
_FLAG = re.compile(r"(?<![\w-])(--[a-z][a-z-]+)")


def code_lines(text):
    """(number, line) of the fenced and indented code of a page, continued lines as one."""
    fenced, kept, start = False, "", 0
    for number, line in enumerate(text.split("\n"), 1):
        if line.startswith("```"):
            fenced = not fenced
            continue
        if not fenced and not line.startswith("    "):
            kept = ""
            continue
        start = start if kept else number
        if line.endswith("\\") and not line.endswith("\\\\"):
            kept += line[:-1] + " "
            continue
        yield start, (kept + line).strip()
        kept = ""


def help_of(program, verb):
    done = subprocess.run([os.path.join(BIN, program), *verb, "--help"], capture_output=True,
                          text=True, timeout=60, check=False)
    return done.stdout if done.returncode == 0 else None


class ShownCommandsTest(unittest.TestCase):
    def test_their_flags_are_known(self):
        helps, seen = {}, 0
        for path in source_tree.project_files(PROJECT):
            if not path.endswith(".md"):
                continue
            with open(os.path.join(PROJECT, path), encoding="utf-8") as file:
                lines = list(code_lines(file.read()))
            for number, line in lines:
                self.assertFalse(line.endswith("\\"),
                                 f"{path}:{number}: two backslashes are no continuation")
                command = re.sub(r"\s#\s.*", "", line)
                match = _PROGRAM.match(command)
                if match is None:
                    continue
                program, rest = match.groups()
                # Up to the next command.
                rest = re.split(r"[|;&>]", rest)[0]
                words = rest.split()
                verb = ()
                if program == "farpoint" and words and re.fullmatch(r"[a-z]+", words[0]):
                    verb = (words[0],)
                key = (program, verb)
                if key not in helps:
                    helps[key] = help_of(program, verb)
                    self.assertIsNotNone(helps[key], f"{path}:{number}: {line}")
                for flag in _FLAG.findall(rest):
                    seen += 1
                    self.assertRegex(helps[key], r"(?<![\w-])" + flag + r"(?![\w-])",
                                     f"{path}:{number}: {' '.join((program, *verb))} has no {flag}")
        self.assertGreater(seen, 100)

    def test_it_finds_what_is_wrong(self):
        page = "text\n\n    farpoint render a.glb \\\n        -o a.exr --tlie 64\n"
        self.assertEqual([(3, "farpoint render a.glb          -o a.exr --tlie 64")],
                         list(code_lines(page)))
        self.assertTrue(list(code_lines("    farpoint a \\\\\n"))[0][1].endswith("\\"))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    BIN = sys.argv.pop()
    unittest.main()
