"""The Kubernetes files are whole, and docker/k8s/check finds what is not."""

import os
import shutil
import subprocess
import sys
import unittest

from tool_test import PROJECT, TreeTest

FOLDER = os.path.join(PROJECT, "docker", "k8s")


def check(folder, *arguments):
    done = subprocess.run([sys.executable, "-B", os.path.join(folder, "check"), *arguments],
                          capture_output=True, text=True, timeout=60)
    return done.returncode, done.stdout + done.stderr


class KubernetesTest(TreeTest):
    def changed(self, name, old, new):
        """What is said of the files with one change."""
        folder = os.path.join(self.root, "k8s")
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(FOLDER, folder, ignore=shutil.ignore_patterns("certs"))
        path = os.path.join(folder, name)
        with open(path, encoding="utf-8") as file:
            text = file.read()
        self.assertIn(old, text)
        with open(path, "w", encoding="utf-8") as file:
            file.write(text.replace(old, new))
        code, said = check(folder)
        self.assertEqual(1, code, said)
        return said

    def test_files_are_whole(self):
        self.assertEqual(0, check(FOLDER)[0], check(FOLDER)[1])

    def test_names_that_lead_nowhere_are_found(self):
        self.assertIn("selects 0 workloads",
                      self.changed("coordinator.yaml",
                                   "  selector:\n    app.kubernetes.io/component: coordinator",
                                   "  selector:\n    app.kubernetes.io/component: director"))
        self.assertIn("port web leads to www",
                      self.changed("coordinator.yaml", "targetPort: web", "targetPort: www"))
        self.assertIn("secret farpoint-worker-keys is not there",
                      self.changed("worker.yaml", "secretName: farpoint-worker-certs",
                                   "secretName: farpoint-worker-keys"))
        self.assertIn("farpoint-workers is not there",
                      self.changed("autoscaling.yaml", "    name: farpoint-worker\n  minReplicas",
                                   "    name: farpoint-workers\n  minReplicas"))
        self.assertIn("no volume is mounted there",
                      self.changed("worker.yaml", "mountPath: /var/cache/farpoint",
                                   "mountPath: /var/cache/other"))
        self.assertIn("selects nothing",
                      self.changed("autoscaling.yaml", "app.kubernetes.io/component: worker",
                                   "app.kubernetes.io/component: labourer"))

    def test_what_would_break_only_later_is_found(self):
        self.assertIn("killed before it has drained",
                      self.changed("worker.yaml", "terminationGracePeriodSeconds: 150",
                                   "terminationGracePeriodSeconds: 30"))
        self.assertIn("asks where nobody listens",
                      self.changed("worker.yaml", "127.0.0.1:7482\", ", "127.0.0.1:7483\", "))
        self.assertIn("do not agree",
                      self.changed("coordinator.yaml", "--web=0.0.0.0:7480", "--web=127.0.0.1:7480"))
        self.assertIn("may more than it needs",
                      self.changed("worker.yaml", "readOnlyRootFilesystem: true",
                                   "readOnlyRootFilesystem: false"))
        self.assertIn("does not fit", self.changed("worker.yaml", "sizeLimit: 32Gi",
                                                   "sizeLimit: 16Gi"))
        self.assertIn("lets others read", self.changed("worker.yaml", "0440", "0444"))
        self.assertIn("POD is not in env", self.changed("worker.yaml", "$(POD_NAME)", "$(POD)"))


if __name__ == "__main__":
    if check(FOLDER)[0] == 77:
        print("Python's yaml is not installed")
        sys.exit(77)
    unittest.main()
