"""The project's files, for the checkers in this folder."""

import os
import subprocess

# Where there is no git (an unpacked archive), these are not part of the project.
_NOT_TRACKED = {".git", ".cache", "build", "out"}


def project_files(root):
    """Paths relative to `root`, with '/', sorted: what git tracks or would, if asked to add all.

    Without git, every file below `root` but build products.
    """
    try:
        listed = subprocess.run(
            ["git", "-C", root, "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            check=True, capture_output=True).stdout
        paths = {path for path in os.fsdecode(listed).split("\0") if path}
    except (OSError, subprocess.CalledProcessError):
        paths = set()
        for folder, folders, files in os.walk(root):
            folders[:] = [name for name in folders if name not in _NOT_TRACKED]
            relative = os.path.relpath(folder, root)
            for name in files:
                paths.add(os.path.normpath(os.path.join(relative, name)).replace(os.sep, "/"))
    # A file that was removed but not yet committed as removed is no longer there to be checked.
    return sorted(path for path in paths if os.path.isfile(os.path.join(root, path)))


def read_text(root, path):
    """The file's text, or None if it is not text in UTF-8."""
    with open(os.path.join(root, path), "rb") as file:
        data = file.read()
    if b"\0" in data:
        return None
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return None


def report(program, violations, files_checked):
    """Prints one line per violation and returns the exit code."""
    for path, line, message in violations:
        print(f"{path}:{line}: {message}")
    if violations:
        print(f"{program}: {len(violations)} violations in {files_checked} files")
        return 1
    print(f"{program}: {files_checked} files, no violation")
    return 0
