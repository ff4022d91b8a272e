"""The messages that docs/troubleshooting.md quotes are those of the source."""

import os
import re
import unittest

from tool_test import PROJECT

_FOLDERS = ("client", "core", "proto", "server", "worker", "tools")


# What makes an error that a user may see.
_ERROR = re.compile(
    r"\b(?:absl::)?(?:InvalidArgument|NotFound|FailedPrecondition|ResourceExhausted|Unavailable"
    r"|DataLoss|PermissionDenied|Unauthenticated|AlreadyExists|Unimplemented|Internal|Disk|File)"
    r"Error\(|\b(?:Bad|bad|Invalid|fault)\(")


def literals():
    """{file: its string literals}, those that stand side by side joined; and the files that are a
    family of errors of their own."""
    texts, families = {}, set()
    for folder in _FOLDERS:
        for path, _, names in os.walk(os.path.join(PROJECT, folder)):
            for name in sorted(names):
                if not name.endswith((".cc", ".h")):
                    continue
                with open(os.path.join(path, name), encoding="utf-8") as file:
                    source = re.sub(r"//[^\n]*", lambda m: m[0] if '"' in m[0] else "", file.read())
                source = re.sub(r'"\s*\n\s*"', "", source)
                name = os.path.relpath(os.path.join(path, name), PROJECT)
                texts[name] = [t.replace('\\"', '"') for t in
                               re.findall(r'"((?:[^"\\\n]|\\.)*)"', source)]
                if len(_ERROR.findall(source)) >= 4 and not name.startswith("tools/"):
                    families.add(name)
    return texts, families


def fragments():
    """[(row, [message])] of the page's tables."""
    with open(os.path.join(PROJECT, "docs", "troubleshooting.md"), encoding="utf-8") as file:
        rows = [line for line in file.read().split("\n") if line.startswith("| ")]
    rows = [row for row in rows if not row.startswith("| Message ")]
    return [(row, re.findall(r"`([^`]*)`", row.split(" | ")[0])) for row in rows]


class TroubleshootingTest(unittest.TestCase):
    def test_every_message_is_in_the_source(self):
        sources = [text for texts in literals()[0].values() for text in texts]
        quoted = 0
        for row, messages in fragments():
            self.assertTrue(messages, f"no message is quoted in: {row}")
            for message in messages:
                quoted += 1
                self.assertTrue(any(message in text for text in sources),
                                f"`{message}` is in no source; the row is: {row}")
        self.assertGreater(quoted, 90)

    def test_every_family_of_errors_is_there(self):
        texts, families = literals()
        messages = [message for _, found in fragments() for message in found]
        self.assertGreater(len(families), 30)
        for family in sorted(families):
            self.assertTrue(any(message in text for text in texts[family] for message in messages),
                            f"docs/troubleshooting.md explains no message of {family}")

    def test_every_row_says_cause_or_cure(self):
        with open(os.path.join(PROJECT, "docs", "troubleshooting.md"), encoding="utf-8") as file:
            for line in file:
                if line.startswith("| `"):
                    cells = line.strip().strip("|").split(" | ")
                    self.assertEqual(3, len(cells), line)


if __name__ == "__main__":
    unittest.main()
