"""What is installed, and who is trusted: requirements with hashes, and a cluster that is reached by TLS alone."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from modcal_core.errors import BadCommand
from modcal_nodes.cli.main import run
from modcal_nodes.fleet.cluster import Certificates, run_on_cluster
from modcal_nodes.fleet.task import DONE, Outcome, Task
from modcal_nodes.io.options import Options

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("name", ["requirements.txt", "requirements-test.txt"])
def test_every_requirement_has_hashes_and_no_address(name: str) -> None:
    text = (ROOT / name).read_text()
    parts = re.split(r"^(?=[a-z0-9-]+==)", text, flags=re.MULTILINE)[1:]
    assert len(parts) > 20
    assert all(re.search(r"--hash=sha256:[0-9a-f]{64}", part) for part in parts)
    assert "://" not in text


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--dask-ca", "f"], "--dask-ca, --dask-cert, --dask-key: go together"),
        (["--dask", "tls://127.0.0.1:1"], "is a TLS address: give --dask-ca"),
        (
            ["--dask", "tcp://127.0.0.1:1", "--dask-ca", "f", "--dask-cert", "f", "--dask-key", "f"],
            "is not reached by TLS",
        ),
        (
            ["--dask", "127.0.0.1:1", "--dask-ca", "f", "--dask-cert", "f", "--dask-key", "f"],
            "--dask tls://127.0.0.1:1: no scheduler answers",
        ),
    ],
)
def test_certificates_that_are_none(
    options: list[str], said: str, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from cli.recordings import stations

    from modcal_msgs_py.recording_write import write_recording

    monkeypatch.chdir(tmp_path)
    (tmp_path / "f").write_text("no certificate")
    write_recording(stations(4), tmp_path / "bag")
    assert run(["fleet", str(tmp_path / "bag"), "--out", str(tmp_path / "out"), *options]) == 2
    error = capfd.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def _named(task: Task) -> Outcome:
    return Outcome(task.name, DONE)


def test_a_cluster_that_wants_certificates_gets_them(tmp_path: Path) -> None:
    """A real scheduler that takes TLS only: with certificates it works, without them nothing is sent."""
    if shutil.which("openssl") is None:
        pytest.skip("no openssl to make certificates with")
    from distributed import LocalCluster
    from distributed.security import Security

    key, cert = tmp_path / "key.pem", tmp_path / "cert.pem"
    subject = ["-subj", "/CN=localhost", "-days", "2"]
    made = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", key, "-out", cert, *subject]
    subprocess.run(made, check=True, capture_output=True, timeout=60.0)
    files = {
        f"tls_{who}_{what}": str(path)
        for who in ("client", "scheduler", "worker")
        for what, path in (("cert", cert), ("key", key))
    }
    security = Security(require_encryption=True, tls_ca_file=str(cert), **files)
    task = Task("a", tmp_path / "a", Options())
    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None, host="127.0.0.1",
                      protocol="tls://", security=security) as cluster:  # fmt: skip
        address = cluster.scheduler_address
        assert address.startswith("tls://")
        (outcome,) = run_on_cluster([task], address, _named, Certificates(cert, cert, key))
        assert outcome.state == DONE
        with pytest.raises(BadCommand, match="is a TLS address"):
            next(run_on_cluster([task], address, _named))
