"""cmake --install into a fresh prefix, and what is there then: programs that run, pages and
completion that say what the programs say."""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import unittest

PROJECT = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))
PROGRAMS = ["farpoint", "farpoint-health", "farpoint-server", "farpoint-worker"]
BUILD = None


def run(*command, **options):
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, **options)


def flags_of(text):
    """The flags that a --help declares: those at the start of an entry's line."""
    found = []
    for line in text.split("\n"):
        match = re.match(r"  ((?:-\w,\s*)?--[a-z][\w-]*|-\w(?=\s))", line)
        if match:
            found.append(match.group(1).split(",")[-1].strip())
    return found


class Install(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls._folder = tempfile.TemporaryDirectory(prefix="farpoint-install-")
        cls.prefix = os.path.join(cls._folder.name, "a prefix")
        done = run("cmake", "--install", BUILD, "--prefix", cls.prefix)
        if done.returncode != 0:
            raise AssertionError(done.stdout + done.stderr)

    @classmethod
    def tearDownClass(cls):
        cls._folder.cleanup()

    def path(self, *parts):
        return os.path.join(self.prefix, *parts)

    def text(self, *parts):
        with open(self.path(*parts), encoding="utf-8") as file:
            return file.read()

    def help(self, program, *words):
        done = run(self.path("bin", program), *words, "--help")
        self.assertEqual(0, done.returncode, done.stderr)
        return done.stdout

    def verbs(self):
        pages = os.listdir(self.path("share", "man", "man1"))
        return sorted(name[len("farpoint-"):-len(".1")] for name in pages
                      if name.startswith("farpoint-") and name[:-len(".1")] not in PROGRAMS)

    def pages(self):
        """(page's name, the command's words) of every page but farpoint's own."""
        return ([(program, [program]) for program in PROGRAMS if program != "farpoint"] +
                [(f"farpoint-{verb}", ["farpoint", verb]) for verb in self.verbs()])

    def test_the_programs_run_from_there(self):
        self.assertEqual(PROGRAMS, sorted(os.listdir(self.path("bin"))))
        for program in PROGRAMS:
            done = run(self.path("bin", program), "--version", cwd="/", env={})
            self.assertEqual((0, True), (done.returncode, done.stdout.startswith(program + " ")), done)
        scene = self.path("share", "doc", "farpoint", "scenes", "furnace.gltf")
        image = self.path("furnace.exr")
        done = run(self.path("bin", "farpoint"), "render", scene, "-o", image, "--resolution", "32x32",
                   "--integrator", "pt", "--paths", "1", "--light-samples", "1", "--quiet", env={})
        self.assertEqual((0, ""), (done.returncode, done.stderr))
        self.assertTrue(os.path.exists(image))

    def test_licence_documents_and_wire_format_are_there(self):
        for name in ("LICENSE", "README.md", "docs/commands.md", "docs/decisions/README.md",
                     "docker/compose.yaml", "scenes/city.glb"):
            self.assertTrue(os.path.getsize(self.path("share", "doc", "farpoint", *name.split("/"))), name)
        done = run("protoc", "--descriptor_set_out=" + os.devnull, "farpoint.proto",
                   cwd=self.path("share", "farpoint", "proto"))
        self.assertEqual((0, ""), (done.returncode, done.stderr))
        for name in ("coordinator.sbatch", "workers.sbatch"):
            script = self.path("share", "farpoint", "slurm", name)
            self.assertTrue(os.access(script, os.X_OK))
            self.assertEqual("", run("bash", "-n", script).stderr)

    def test_links_between_installed_documents_lead_somewhere(self):
        folder = self.path("share", "doc", "farpoint")
        broken = []
        for here, _, names in os.walk(folder):
            for name in (name for name in names if name.endswith(".md")):
                for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", self.text(here, name)):
                    if not re.match(r"[a-z]+:", target) and \
                            not os.path.exists(os.path.normpath(os.path.join(here, target))):
                        broken.append(f"{os.path.relpath(os.path.join(here, name), folder)}: {target}")
        # Sources stay where they are.
        self.assertEqual([], [line for line in broken if not re.search(
            r": (\.\./)*(bench|client|core|proto|server|tests|tools|worker)/", line)])

    def test_every_command_and_flag_has_its_place_in_the_manual(self):
        overview = self.help("farpoint")
        for verb in self.verbs():
            self.assertRegex(overview, rf"\b{verb}\b")
        self.assertIn("render", self.verbs())
        for name, words in self.pages():
            page = self.text("share", "man", "man1", name + ".1").replace("\\-", "-")
            flags = flags_of(self.help(*words))
            self.assertGreaterEqual(len(flags), 4, name)
            for flag in flags:
                self.assertRegex(page, rf"\\fB{flag}\\fR", name)
            self.assertIn(f".BR {name} (1)", self.text("share", "man", "man1", "farpoint.1").replace("\\-", "-"))

    def test_no_page_tells_of_the_machine_that_made_it(self):
        for name in os.listdir(self.path("share", "man", "man1")):
            page = self.text("share", "man", "man1", name).replace("\\-", "-")
            self.assertNotIn(os.path.expanduser("~") + "/", page, name)
            self.assertNotIn(os.uname().nodename + ":", page, name)

    @unittest.skipUnless(shutil.which("groff"), "groff is not installed")
    def test_the_pages_are_good_roff(self):
        for name in sorted(os.listdir(self.path("share", "man", "man1"))):
            done = run("groff", "-man", "-ww", "-z", "-Tutf8", self.path("share", "man", "man1", name))
            self.assertEqual("", done.stderr, name)

    def complete(self, *words):
        """What bash offers for the last word."""
        # compopt works within a completion only.
        script = ('compopt() { :; }; source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); '
                  '"_${1//-/_}"; printf "%s\\n" "${COMPREPLY[@]}"')
        done = run("bash", "-c", script, "bash",
                   self.path("share", "bash-completion", "completions", words[0]), *words,
                   cwd=self.path("share", "doc", "farpoint"))
        self.assertEqual("", done.stderr)
        return done.stdout.split()

    def test_bash_completes_commands_flags_values_and_files(self):
        self.assertEqual(["render", "requeue", "resume"], sorted(self.complete("farpoint", "re")))
        self.assertEqual(self.verbs(), sorted(word for word in self.complete("farpoint", "")
                                              if not word.startswith("-")))
        self.assertEqual(["--integrator"], self.complete("farpoint", "render", "--integ"))
        self.assertEqual(["pbgi", "pt"], sorted(self.complete("farpoint", "render", "--integrator", "p")))
        self.assertEqual(["README.md"], self.complete("farpoint", "render", "READ"))
        self.assertEqual(["scenes"], self.complete("farpoint", "submit", "x", "--certs", "sce"))
        self.assertEqual(["json"], self.complete("farpoint-worker", "--log-format", "j"))
        self.assertEqual(["revoke"], self.complete("farpoint", "certs", "rev"))

    def test_bash_completes_every_flag(self):
        for _, words in self.pages():
            offered = self.complete(*words, "--")
            self.assertEqual([], sorted(set(flags_of(self.help(*words))) - set(offered)), words)

    def test_zsh_knows_every_flag(self):
        text = self.text("share", "zsh", "site-functions", "_farpoint")
        self.assertTrue(text.startswith("#compdef " + " ".join(["farpoint"] + [
            word for word in text.split("\n")[0].split()[2:]])))
        for _, words in self.pages():
            section = re.search(rf"^\s*{words[-1]}\) _arguments(.*?)^\s*;;", text, re.M | re.S).group(1)
            for flag in flags_of(self.help(*words)):
                self.assertIn(f"{flag}[", section, words)

    @unittest.skipUnless(shutil.which("zsh"), "zsh is not installed")
    def test_zsh_can_read_it(self):
        done = run("zsh", "-n", self.path("share", "zsh", "site-functions", "_farpoint"))
        self.assertEqual("", done.stderr)

    def test_components_can_be_installed_alone(self):
        prefix = self.path("worker-only")
        done = run("cmake", "--install", BUILD, "--prefix", prefix, "--component", "worker")
        self.assertEqual(0, done.returncode, done.stderr)
        installed = [os.path.relpath(os.path.join(here, name), prefix)
                     for here, _, names in os.walk(prefix) for name in names]
        self.assertEqual([os.path.join("bin", "farpoint-worker")], installed)

    def test_files_for_deploying_give_flags_that_the_programs_know(self):
        docker = self.path("share", "doc", "farpoint", "docker")
        # Commands as they stand there, over several lines or as lists.
        found = 0
        for name in ("Dockerfile", "compose.yaml", "try", "slurm/coordinator.sbatch",
                     "slurm/workers.sbatch", "systemd/farpoint-server.service",
                     "systemd/farpoint-worker.service"):
            text = re.sub(r"\\\n", " ", self.text(docker, *name.split("/")))
            text = re.sub(r"#.*", "", text)
            program = None
            for line in text.split("\n"):
                named = re.search(r"farpoint-(server|worker|health)(?![\w.-])", line)
                if re.match(r"ENTRYPOINT", line):
                    program = named.group() if named else None
                elif named and not line.startswith("RUN"):
                    program = named.group()
                elif not line.startswith("CMD"):
                    program = None
                if program is None:
                    continue
                flags = flags_of(self.help(program))
                for flag in re.findall(r"(?<![\w-])--[a-z][\w-]*", line):
                    if flag in ("--interval", "--timeout", "--start-period", "--retries"):
                        continue  # HEALTHCHECK's
                    found += 1
                    self.assertIn(flag, flags, f"{name}: {line.strip()}")
        self.assertGreaterEqual(found, 15)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--build", required=True)
    arguments, rest = parser.parse_known_args()
    BUILD = arguments.build
    unittest.main(argv=sys.argv[:1] + rest)
