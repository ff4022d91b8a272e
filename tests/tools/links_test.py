"""Links and pictures of the Markdown pages lead somewhere; so do their anchors."""

import os
import re
import sys
import unittest

from tool_test import PROJECT

sys.path.insert(0, os.path.join(PROJECT, "tools"))
sys.dont_write_bytecode = True
import source_tree  # noqa: E402

_LINK = re.compile(r"\]\(([^()\s]+)\)")


def anchors(path):
    """What a page's headings are called in links."""
    names = set()
    with open(path, encoding="utf-8") as file:
        text = re.sub(r"```.*?```", "", file.read(), flags=re.S)
    for heading in re.findall(r"^#+ (.*)$", text, re.M):
        heading = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").lower()
        names.add(re.sub(r"[^\w\- ]", "", heading).strip().replace(" ", "-"))
    return names


class LinksTest(unittest.TestCase):
    def test_every_link_leads_somewhere(self):
        links = 0
        for path in source_tree.project_files(PROJECT):
            if not path.endswith(".md"):
                continue
            with open(os.path.join(PROJECT, path), encoding="utf-8") as file:
                text = re.sub(r"```.*?```", "", file.read(), flags=re.S)
            for link in _LINK.findall(text):
                if re.match(r"[a-z]+:", link):
                    continue
                links += 1
                name, _, anchor = link.partition("#")
                target = os.path.normpath(os.path.join(PROJECT, os.path.dirname(path), name)) \
                    if name else os.path.join(PROJECT, path)
                self.assertTrue(os.path.exists(target), f"{path}: {link} leads nowhere")
                if anchor and target.endswith(".md"):
                    self.assertIn(anchor, anchors(target), f"{path}: {link}")
        self.assertGreater(links, 100)


if __name__ == "__main__":
    unittest.main()
