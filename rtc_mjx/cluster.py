"""Where a training runs: on this machine's devices, or together with other processes, by JAX's own distributed runtime.

    where am I (flags; Slurm, Open MPI, Kubernetes) -> the processes meet (`rtc_mjx.team`): settings, versions -> jax.distributed

JAX's runtime moves the numbers. But it aborts, with a stack trace, a process whose companions do not come or die, and it does not know
whether they train the same thing. So they meet before it starts, on the coordinator's port, which JAX then takes over, and keep watch.
"""

import atexit
import contextlib
import ctypes
import os
import signal
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import jax
from jax._src.clusters import ClusterEnv  # what jax.distributed.initialize itself asks where it runs; there is no public name

from rtc_mjx.errors import UsageError
from rtc_mjx.team import ALONE, GO_ON, Place, Team, leave, meet


@dataclass(frozen=True)
class Hardware:
    """Where a training runs; no number depends on it, but for rounding.

    Attributes:
        devices: how many of this machine's devices to use; as many as the work divides among if not given.
        distributed: train together with other processes, on all devices of all of them.
        coordinator: HOST:PORT of the first process; known by itself under Slurm, Open MPI and Kubernetes, as are the next two.
        process_id: number of this process, from 0.
        process_count: how many processes there are.
        timeout: seconds after which a process that does not come, or is not heard of any more, is given up.
    """

    devices: int | None = None
    distributed: bool = False
    coordinator: str | None = None
    process_id: int | None = None
    process_count: int | None = None
    timeout: int = 60

    def check(self) -> "Hardware":
        """The options, if they fit each other.

        Raises:
            UsageError: they do not.
        """
        if self.devices is not None and self.devices < 1:
            raise UsageError(f"--devices {self.devices}: at least 1 is needed")
        if self.timeout < 5:
            raise UsageError(f"--timeout {self.timeout}: at least 5 seconds are needed")
        given = {"coordinator": self.coordinator, "process-id": self.process_id, "process-count": self.process_count}
        for name, value in given.items():
            if value is not None and not self.distributed:
                raise UsageError(f"--{name} {value}: belongs to --distributed")
        if self.distributed and self.devices is not None:
            raise UsageError(f"--devices {self.devices}: with --distributed all devices are used")
        return self


def place(options: Hardware) -> Place:
    """Where this process stands, by its options and else by what started it.

    Raises:
        UsageError: neither says so, or what they say is impossible.
    """
    local_devices = [int(x) for x in os.environ.get("JAX_LOCAL_DEVICE_IDS", "").split(",") if x.strip().isdigit()] or None
    address = options.coordinator or os.environ.get("JAX_COORDINATOR_ADDRESS")
    found: Any = (address, options.process_count, options.process_id, local_devices)
    detect: Any = ClusterEnv.auto_detect_unset_distributed_params
    try:
        if None in found[:3] or "KUBERNETES_SERVICE_HOST" not in os.environ:  # there it asks the cluster, if not in vain
            found = detect(*found, None, options.timeout)
    except Exception as error:  # each kind of cluster is asked by a library of its own, with errors of its own
        raise UsageError(f"--distributed: the job that this process belongs to cannot be read: {' '.join(str(error).split())}") from error
    address, count, process, local = found
    wanted = {"--coordinator HOST:PORT": address, "--process-count": count, "--process-id": process}
    absent = [name for name, value in wanted.items() if value is None]
    if absent:
        raise UsageError(f"--distributed: no job of Slurm, Open MPI or Kubernetes is found here; say {', '.join(absent)}")
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 1 << 16:
        raise UsageError(f"--coordinator {address}: HOST:PORT is needed, such as node1:12355")
    if count < 1 or not 0 <= process < count:
        raise UsageError(f"--process-id {process}: a number from 0 to --process-count {count} less one is needed")
    return Place(host.strip("[]"), int(port), process, count, local)


@contextlib.contextmanager
def joined(options: Hardware, told: Mapping[str, Any]) -> Iterator[Team]:
    """The team of this process; without --distributed it is alone. Comes before JAX is used.

    Args:
        options: who takes part.
        told: what must be the same in all processes, by name.

    Raises:
        UsageError: the options are impossible, the coordinator cannot be reached, or processes differ in what they were told.
        RunError: a process did not come.
    """
    if not options.check().distributed:
        yield ALONE
        return
    here = place(options)
    team = meet(here, told, options.timeout)
    team.watch()
    _explain_aborts(team)
    jax.config.update("jax_enable_preemption_service", False)  # it would take SIGTERM from the training, which saves a checkpoint then
    patience = 10 * options.timeout  # ours ends first
    jax.distributed.initialize(
        here.address, here.count, here.process, here.local_devices, "deactivate",
        initialization_timeout=patience, heartbeat_timeout_seconds=patience,
    )  # fmt: skip
    try:
        jax.devices()  # devices are found by all processes together: the first may be the only one to need them for a while
        yield team
        team.exchange(None, last=True)
    except BaseException as error:
        if isinstance(error, jax.errors.JaxRuntimeError):
            time.sleep(2 * options.timeout)  # numbers from another process did not come: meanwhile the watch learns whose, and ends this
        status = 2 if isinstance(error, UsageError) else 1
        team.stop_all(f"{team.name(team.process)} stops: {_one_line(error)}", status)
        atexit.register(leave, status)  # before JAX's farewell, which waits for processes that are gone
        raise
    jax.distributed.shutdown()
    for link in team.links.values():
        link.close()


def _explain_aborts(team: Team) -> None:
    """JAX's runtime aborts the process where it misses its coordinator before our watch does; it then leaves with a line and status 1.

    Python's own signal handlers would not run: the thread that aborts is not Python's.
    """
    line = f"{team.name(team.process)} was aborted by JAX's runtime: {team.name(0)}, the coordinator, seems gone{GO_ON}\n".encode()

    @ctypes.CFUNCTYPE(None, ctypes.c_int)
    def explain(_: int) -> None:
        os.write(2, line)
        os._exit(1)

    ctypes.CDLL(None).signal(int(signal.SIGABRT), explain)
    atexit.register(lambda: explain)  # as long as the process lives, it may be called


def _one_line(error: BaseException) -> str:
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    return (str(error).splitlines() or [type(error).__name__])[0][:300]
