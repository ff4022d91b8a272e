"""tools/check_prose on trees with one violation each. Its words are put together from pieces, so
that the checker does not find them in this file."""

import os
import unittest

from tool_test import TreeTest

HOME, ROOT, WORK, USERS = "/ho" + "me", "/ro" + "ot", "/wo" + "rk", "/Us" + "ers"


class CheckProse(TreeTest):
    def test_absolute_paths_of_a_machine_are_reported_with_their_line(self):
        for path in (f"{HOME}/ada/scene.gltf", f"{ROOT}/x", f"{WORK}/main", f"{USERS}/ada/x",
                     f"'{ROOT}'", f'"{WORK}/x"', f"see {ROOT}, or"):
            with self.subTest(path=path):
                code, lines = self.check("check_prose", {"docs/x.md": f"one\ntwo {path}\n"})
                self.assertEqual((1, 2), (code, len(lines)), lines)
                self.assertTrue(lines[0].startswith("docs/x.md:2: "), lines[0])

    def test_relative_paths_and_urls_are_not(self):
        code, lines = self.check("check_prose", {"docs/x.md": "\n".join([
            f"src{ROOT}/x", f"https://example.com{HOME}/ada", f"${{x}}{WORK}/y", f"{ROOT}s",
            f"a/b{WORK}/c", f"..{WORK}/d", f"{WORK}er"])})
        self.assertEqual(0, code, lines)

    def test_markers_of_undone_work_are_reported(self):
        for marker in ("TO" + "DO", "FIX" + "ME", "XX" + "X"):
            with self.subTest(marker=marker):
                code, lines = self.check("check_prose", {"core/x.cc": f"\n\n// {marker}: later\n"})
                self.assertEqual((1, 2), (code, len(lines)), lines)
                self.assertTrue(lines[0].startswith("core/x.cc:3: "), lines[0])

    def test_a_template_for_mkstemp_is_no_marker(self):
        code, lines = self.check("check_prose", {"core/x.cc": 'char name[] = "aXXXXXX";\n'})
        self.assertEqual(0, code, lines)

    def test_conflict_markers_are_reported(self):
        code, lines = self.check("check_prose", {"core/x.cc": "<" * 7 + " HEAD\n"})
        self.assertEqual((1, 2), (code, len(lines)), lines)

    def test_binary_files_are_left_alone(self):
        with open(os.path.join(self.root, "image.bin"), "wb") as file:
            file.write(b"\0\xff " + WORK.encode() + b"/x")
        code, lines = self.check("check_prose", {"a.txt": "text\n"})
        self.assertEqual((0, ["check_prose: 1 files, no violation"]), (code, lines))


if __name__ == "__main__":
    unittest.main()
