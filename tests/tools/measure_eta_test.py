"""tools/measure_eta reads what the console draws, and counts errors as it says."""

import importlib.machinery
import importlib.util
import os
import sys
import unittest

from tool_test import PROJECT


def load():
    path = os.path.join(PROJECT, "tools", "measure_eta")
    loader = importlib.machinery.SourceFileLoader("measure_eta", path)
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader("measure_eta", loader))
    loader.exec_module(module)
    return module


measure_eta = load()


class MeasureEtaTest(unittest.TestCase):
    def test_reads_bars(self):
        # As ProgressText of client/console.h makes them.
        drawn = (b"\rbaking, 0:12\x1b[K"
                 b"\r[----------]   0 %  0/4 tiles\x1b[K"
                 b"\r[####------]  45 %  2/4 tiles  1/2 frames  2 again  eta 1:05\x1b[K"
                 b"\r[########--]  80 %  3/4 tiles  eta 2:03:04\x1b[K")
        script = f"import sys; sys.stderr.buffer.write({drawn!r}); sys.stderr.flush()"
        seen = measure_eta.run([sys.executable, "-c", script])
        self.assertEqual([(0, None), (45, 65), (80, 7384)], [s[1:] for s in seen])

    def test_counts_errors_from_the_first_bar_on(self):
        seen = [(100, 0, None), (110, 20, 60), (150, 50, 55), (199.5, 90, 9), (200, 100, None)]
        errors = measure_eta.errors_of(seen)
        self.assertEqual([20, 30, 40, 50], sorted(errors))  # at 90 % half a second was left
        whole, left = errors[20]
        self.assertAlmostEqual(70 / 100 - 1, whole)
        self.assertAlmostEqual(60 / 90 - 1, left)
        whole, left = errors[50]
        self.assertAlmostEqual(105 / 100 - 1, whole)
        self.assertAlmostEqual(55 / 50 - 1, left)

    def test_says_which_run_failed(self):
        with self.assertRaises(SystemExit):
            measure_eta.run([sys.executable, "-c", "import sys; sys.exit(3)"])


if __name__ == "__main__":
    unittest.main()
