"""The messages that docs/troubleshooting.md quotes are those of the source."""

import os
import re
import unittest

from tool_test import PROJECT

_FOLDERS = ("client", "core", "proto", "server", "worker", "tools")


def literals():
    """The string literals of the sources, those that stand side by side joined."""
    texts = []
    for folder in _FOLDERS:
        for path, _, names in os.walk(os.path.join(PROJECT, folder)):
            for name in sorted(names):
                if not name.endswith((".cc", ".h")):
                    continue
                with open(os.path.join(path, name), encoding="utf-8") as file:
                    source = re.sub(r"//[^\n]*", lambda m: m[0] if '"' in m[0] else "", file.read())
                source = re.sub(r'"\s*\n\s*"', "", source)
                texts += [t.replace('\\"', '"') for t in
                          re.findall(r'"((?:[^"\\\n]|\\.)*)"', source)]
    return texts


class TroubleshootingTest(unittest.TestCase):
    def test_every_message_is_in_the_source(self):
        with open(os.path.join(PROJECT, "docs", "troubleshooting.md"), encoding="utf-8") as file:
            rows = [line for line in file.read().split("\n") if line.startswith("| ")]
        sources = literals()
        quoted = 0
        for row in rows:
            message = row.split(" | ")[0]
            if message in ("| Message",):
                continue
            fragments = re.findall(r"`([^`]*)`", message)
            self.assertTrue(fragments, f"no message is quoted in: {row}")
            for fragment in fragments:
                quoted += 1
                self.assertTrue(any(fragment in text for text in sources),
                                f"`{fragment}` is in no source; the row is: {row}")
        self.assertGreater(quoted, 60)

    def test_every_row_says_cause_or_cure(self):
        with open(os.path.join(PROJECT, "docs", "troubleshooting.md"), encoding="utf-8") as file:
            for line in file:
                if line.startswith("| `"):
                    cells = line.strip().strip("|").split(" | ")
                    self.assertEqual(3, len(cells), line)


if __name__ == "__main__":
    unittest.main()
