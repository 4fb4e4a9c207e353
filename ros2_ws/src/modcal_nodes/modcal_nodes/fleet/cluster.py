"""Tasks on a cluster that runs already: Dask distributed. Its workers read the bags; this process writes the results.

A worker that dies is the scheduler's to replace: it gives the task to another one, as often as its
``distributed.scheduler.allowed-failures`` says, and then the task is said to have failed.

What goes to and fro is pickled, and unpickling runs whatever a pickle says: whoever is the scheduler, or a worker, can
run code here, and whoever reaches the scheduler can run code there. TLS, with certificates of both sides, is what keeps
others out.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from modcal_core.errors import BadCommand
from modcal_nodes.fleet.task import FAILED, Outcome, Task


@dataclass(frozen=True)
class Certificates:
    """Files of PEM for TLS: of the authority that signed the cluster's, our own certificate, and its key."""

    authority: Path
    certificate: Path
    key: Path

    @classmethod
    def of(cls, authority: Path | None, certificate: Path | None, key: Path | None) -> Certificates | None:
        """From options, all or none of which are given. Raises BadCommand."""
        given = (authority, certificate, key)
        if all(one is None for one in given):
            return None
        if authority is None or certificate is None or key is None:
            raise BadCommand("--dask-ca, --dask-cert, --dask-key", "go together", "give all three, or none")
        return cls(authority, certificate, key)


def run_on_cluster(
    tasks: Sequence[Task], address: str, work: Callable[[Task], Outcome], certificates: Certificates | None = None
) -> Generator[Outcome, None, None]:
    """What becomes of each task, as it is finished. Raises BadCommand where no cluster answers.

    work: does a task; a function that the workers can import. certificates: with them nothing is sent but by TLS.
    """
    if certificates is None and address.partition("://")[0] == "tls":
        raise BadCommand(f"--dask {address}", "is a TLS address", "give --dask-ca, --dask-cert and --dask-key")
    if certificates is not None and "://" in address and not address.startswith("tls://"):
        raise BadCommand(f"--dask {address}", "is not reached by TLS", "give tls://host:port with the certificates")
    try:
        from distributed import Client, as_completed  # only who has a cluster has it installed
    except ImportError as error:
        raise BadCommand("--dask", "needs the package distributed", "pip install distributed") from error
    try:
        if certificates is not None and "://" not in address:
            address = f"tls://{address}"
        client = Client(address, timeout="10s", set_as_default=False, security=_security(certificates))
    except (OSError, TimeoutError, ValueError) as error:
        said = f"no scheduler answers ({' '.join(str(error).split())})"
        raise BadCommand(f"--dask {address}", said, "give its address, host:port") from error
    with client:
        futures = {client.submit(work, task, pure=False, key=f"modcal-{task.name}"): task for task in tasks}
        try:
            for future in as_completed(list(futures), loop=client.loop):
                task, fault = futures[future], future.exception()
                yield future.result() if fault is None else Outcome(task.name, FAILED, _line(fault))
                future.release()  # its files need not stay on the cluster
        finally:
            client.cancel([future for future in futures if not future.done()])


def _security(certificates: Certificates | None) -> Any:
    """What Dask is to be told of TLS; nothing where there are no certificates, so that its own configuration holds."""
    if certificates is None:
        return None
    from distributed.security import Security

    return Security(
        require_encryption=True,
        tls_ca_file=str(certificates.authority),
        tls_client_cert=str(certificates.certificate),
        tls_client_key=str(certificates.key),
    )


def _line(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]
