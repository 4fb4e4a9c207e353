"""Copies of this checkout in which faults are put in and tests are run; the checkout itself is never changed."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import queue
import re
import shutil
import signal
import subprocess
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from fragments import SOURCES
from harness import ROOT

PROBE = Path(__file__).with_name("probe.py")
_MADE = re.compile(r"__pycache__|\.egg-info")
# another ROS that is sourced would put its modules before those of .venv
_FOREIGN = re.compile(
    r"PYTHONPATH|PYTHONHOME|LD_LIBRARY_PATH|(AMENT|COLCON|CMAKE)_PREFIX_PATH|VIRTUAL_ENV|_ROS_WHEELS_.*|MUTANTS_.*"
)


def files_of(root: Path) -> list[Path]:
    """What belongs to a checkout, committed or not yet, as it stands."""
    command = ["git", "ls-files", "-z", "-co", "--exclude-standard"]
    listed = subprocess.run(command, cwd=root, check=True, capture_output=True, text=True).stdout
    return [Path(name) for name in sorted(set(listed.split("\0"))) if name and (root / name).is_file()]


def digests(folder: Path) -> dict[str, str]:
    """What stands in the files of a folder, by their names in it."""
    files = [p for p in sorted(folder.rglob("*")) if p.is_file() and not _MADE.search(str(p))]
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()[:12] for p in files}


def environment(settings: Mapping[str, str]) -> dict[str, str]:
    return {**{name: value for name, value in os.environ.items() if not _FOREIGN.fullmatch(name)}, **settings}


class Copy:
    """One copy: a clone with what is not committed on top of it, its own build, and the probe."""

    def __init__(self, folder: Path, tests: Path | None = None) -> None:
        """Make it, or take one that stands there already. tests: a folder in place of the checkout's own."""
        self.root = folder / "main"
        self._process: subprocess.Popen[bytes] | None = None
        if not (folder / "ready").exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            self._make(ROOT, tests)
            (folder / "ready").touch()

    def _make(self, root: Path, tests: Path | None) -> None:
        subprocess.run(["git", "clone", "-q", str(root), str(self.root)], check=True)
        for name in files_of(self.root):
            (self.root / name).unlink()
        for name in files_of(root):
            (self.root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(root / name, self.root / name)
        if tests is not None:
            shutil.rmtree(self.root / "tests")
            shutil.copytree(tests, self.root / "tests", ignore=shutil.ignore_patterns("__pycache__"))
        if (root.parent / "shared").exists():
            (self.root.parent / "shared").symlink_to((root.parent / "shared").resolve())
        theirs, ours = str(root / ".venv"), str(self.root / ".venv")
        if subprocess.run(["cp", "-al", theirs, ours], stderr=subprocess.DEVNULL).returncode:
            shutil.rmtree(ours, ignore_errors=True)  # on another disk there are no links
            subprocess.run(["cp", "-a", theirs, ours], check=True)
        for script in Path(ours, "bin").iterdir():
            if script.is_symlink() or not script.is_file() or script.stat().st_size > 100_000:
                continue
            text, mode = script.read_bytes(), script.stat().st_mode
            script.unlink()  # not through the link, or it would change theirs
            script.write_bytes(text.replace(theirs.encode(), ours.encode()))
            script.chmod(mode)
        probe = self.root / SOURCES / "modcal_core" / "mutants_probe.py"  # a folder that every Python of .venv sees
        shutil.copy2(PROBE, probe)
        with (self.root / ".git/info/exclude").open("a") as stream:
            stream.write(f"/{probe.relative_to(self.root)}\n")
        build = [str(self.root / "scripts/build.sh")]
        subprocess.run(build, check=True, env=environment({}), stdout=subprocess.DEVNULL)

    def write(self, path: Path, text: str) -> None:
        """Put another text in place of a file, whose compiled form might have the same size and second."""
        path.write_text(text, encoding="utf-8")
        for compiled in path.parent.glob(f"__pycache__/{path.stem}.*.pyc"):
            compiled.unlink()

    def names(self, tests: Sequence[str]) -> str:
        """A file with names of tests, for the probe."""
        file = self.root.parent / "tests.json"
        file.write_text(json.dumps(tests))
        return str(file)

    def pytest(self, arguments: Sequence[str], settings: Mapping[str, str], seconds: float) -> int:
        """Exit code of a run of the tests; −1 where it took longer than this and was ended."""
        command = [str(self.root / ".venv/bin/python"), "-m", "pytest", "-q", "-p", "mutants_probe"]
        command += ["-p", "no:cacheprovider", *arguments]
        with (self.root.parent / "pytest.log").open("ab") as log:
            about = {"cwd": self.root, "env": environment(settings), "start_new_session": True}
            self._process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, **about)
            try:
                return self._process.wait(seconds)
            except subprocess.TimeoutExpired:
                return -1
            finally:
                self.end()

    def end(self) -> None:
        """End what is running, with all that it has started."""
        if self._process is not None and self._process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()


class Copies:
    """As many copies as there are workers. clean: takes out of one what an interrupted run has left."""

    def __init__(self, folder: Path, tests: Path | None, count: int, clean: Callable[[Copy], None]) -> None:
        self._folders, self._tests, self._clean = [folder / str(k) for k in range(count)], tests, clean
        self._made: list[Copy] = []
        self.ended = False  # interrupted: what still comes in says nothing

    def all(self) -> list[Copy]:
        """Made when they are needed first."""
        if not self._made:
            self._made = [Copy(folder, self._tests) for folder in self._folders]
            for copy in self._made:
                self._clean(copy)
        return self._made

    def share(self, work: Callable[[Copy, Any], None], items: Sequence[Any]) -> None:
        """The work on every item, each on a copy of its own; then all copies are clean."""
        free: queue.SimpleQueue[Copy] = queue.SimpleQueue()
        for copy in self.all():
            free.put(copy)

        def one(item: Any) -> None:
            copy = free.get()
            try:
                work(copy, item)
            finally:
                free.put(copy)

        with ThreadPoolExecutor(len(self._made)) as pool:
            try:
                for done in [pool.submit(one, item) for item in items]:
                    done.result()
            except BaseException:
                self.ended = True
                pool.shutdown(wait=False, cancel_futures=True)
                for copy in self._made:
                    copy.end()
                raise
            finally:
                for copy in self._made:
                    self._clean(copy)
