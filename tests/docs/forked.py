"""Verbs of ``modcal`` without what every interpreter takes to begin: a process that has imported them forks for each.

``python forked.py SOCKET``, with nothing else, is that process; ``python forked.py SOCKET WORDS…`` asks it for a verb, and
lends it its standard streams, folder and environment.
"""

from __future__ import annotations

import json
import os
import socket
import sys


def serve(path: str) -> None:
    """Fork a child for each call, one after the other, and answer with its exit code; end with who began it."""
    import gc
    from importlib import import_module

    from modcal_nodes.cli.main import VERBS, run

    for module, _ in VERBS.values():
        import_module(f"modcal_nodes.cli.{module}")
    for late in ("modcal_core.report.html", "matplotlib.figure", "jinja2", "mujoco"):
        import_module(late)
    gc.freeze()
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(f"{path}.new")
        server.listen()
        os.rename(f"{path}.new", path)
        server.settimeout(1.0)
        parent = os.getppid()
        while os.getppid() == parent:
            try:
                caller, _ = server.accept()
            except TimeoutError:
                continue
            with caller:
                caller.settimeout(None)
                words, streams, _, _ = socket.recv_fds(caller, 1 << 20, 3)
                call = json.loads(words)
                child = os.fork()
                if child == 0:
                    for here, there in enumerate(streams):
                        os.dup2(there, here)
                    os.chdir(call["folder"])
                    os.environ.clear()
                    os.environ.update(call["environment"])
                    code = run(call["words"])
                    sys.stdout.flush()
                    sys.stderr.flush()
                    os._exit(code)
                for stream in streams:
                    os.close(stream)
                _, status = os.waitpid(child, 0)
                caller.send(bytes([os.waitstatus_to_exitcode(status) & 0xFF]))


def ask(path: str, words: list[str]) -> int:
    """Exit code of a verb."""
    with socket.socket(socket.AF_UNIX) as server:
        server.connect(path)
        call = {"words": words, "folder": os.getcwd(), "environment": dict(os.environ)}
        socket.send_fds(server, [json.dumps(call).encode()], [0, 1, 2])
        answer = server.recv(1)
    return answer[0] if answer else 1


if __name__ == "__main__":
    if len(sys.argv) > 2:
        sys.exit(ask(sys.argv[1], sys.argv[2:]))
    serve(sys.argv[1])
