"""Processes that work together: they say hello, compare what they were told, talk, and none waits for one that is gone.

    hello to the first process -> compared -> a line to it stays open: what processes tell each other, and signs of life

The line is a TCP connection: it breaks at once where a process dies, and falls silent where a machine does. It carries lines of JSON,
read as data; they are neither signed nor secret, so the port belongs on a network that is.
"""

import contextlib
import json
import os
import queue
import socket
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NoReturn

from rtc_mjx.errors import RunError, UsageError

RETRY_S = 0.2  # between attempts to reach the coordinator
GRACE_S = 1.0  # for which the first process stays after saying why all must stop, so that they read it before JAX misses its coordinator
SIGNS = 5  # signs of life that a process gives in the time after which its silence counts as death
LONGEST_LINE = 1 << 24  # bytes
HELLO_S = 5.0  # in which whoever calls must say hello
GO_ON = "; all processes stop, --resume goes on from the last checkpoint"


@dataclass(frozen=True)
class Place:
    """Which of how many processes this is, where the first one listens, and which of its machine's devices it has; None: all."""

    host: str
    port: int
    process: int
    count: int
    local_devices: Sequence[int] | None = None

    @property
    def address(self) -> str:
        """Of the coordinator."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


class Link:
    """A line to another process: JSON objects, one after another."""

    def __init__(self, connection: socket.socket, patience: float) -> None:
        connection.settimeout(patience)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.connection, self.lines, self.writing = connection, connection.makefile("rb"), threading.Lock()

    def send(self, **message: Any) -> None:
        """Sends one object.

        Raises:
            OSError: it cannot be delivered.
        """
        with self.writing:
            self.connection.sendall(json.dumps(message).encode() + b"\n")

    def receive(self) -> dict[str, Any]:
        """Waits for the next object.

        Raises:
            OSError: there is none for as long as patience lasts, or the line is broken.
            ValueError: what comes is none.
        """
        line = self.lines.readline(LONGEST_LINE)
        if not line.endswith(b"\n"):
            raise ConnectionResetError("the connection is closed")
        message = json.loads(line)
        if not isinstance(message, dict):
            raise ValueError("not an object")
        return message

    def close(self) -> None:
        """Closes the line, also under whoever waits for it."""
        with contextlib.suppress(OSError):  # it is broken already
            self.connection.shutdown(socket.SHUT_RDWR)
        self.lines.close()
        self.connection.close()


@dataclass(eq=False)
class Team:
    """The processes of a training, as one of them sees it. Alone, it has no links and exchanges with itself.

    Attributes:
        process: which this is.
        hosts: of all processes, in their order.
        links: to the others by process: the first has one to each, the others one to the first.
        patience: seconds of silence after which a process counts as dead.
    """

    process: int = 0
    hosts: tuple[str, ...] = ("",)
    links: Mapping[int, Link] = field(default_factory=dict)
    patience: float = 60.0

    def __post_init__(self) -> None:
        self._inbox: dict[int, queue.SimpleQueue[Any]] = {process: queue.SimpleQueue() for process in self.links}
        self._parting, self._ending = False, threading.Lock()

    @property
    def leads(self) -> bool:
        """Whether this is the first process: the one that writes and shows."""
        return self.process == 0

    def name(self, process: int) -> str:
        """What a user finds a process by."""
        return f"process {process} ({self.hosts[process]})"

    def exchange(self, value: Any, last: bool = False) -> list[Any]:
        """Gives a value (as JSON holds it) and waits for those of all processes; returns them in the order of processes.

        After the last exchange processes may go as they like.
        """
        if not self.links:
            return [value]
        if not self.leads:
            self._send(0, value=value)
            return list(self._inbox[0].get())
        values = [value, *(self._inbox[process].get() for process in sorted(self.links))]
        self._parting = last
        for process in self.links:
            self._send(process, values=values, last=last)
        return values

    def of_first(self, value: Any) -> Any:
        """The first process's value."""
        return self.exchange(value)[0]

    def watch(self) -> None:
        """From now on this process ends, with a line and status 1, as soon as another one is gone."""
        for process in self.links:
            threading.Thread(target=self._listen, args=(process,), daemon=True).start()
        threading.Thread(target=self._give_signs, daemon=True).start()

    def stop_all(self, reason: str, status: int) -> None:
        """Tells the others that this process ends, and why."""
        self._parting = True
        for link in self.links.values():
            with contextlib.suppress(OSError):  # that one is gone itself
                link.send(stop=reason, status=status)
        if self.leads and self.links:
            time.sleep(GRACE_S)

    def _send(self, process: int, **message: Any) -> None:
        try:
            self.links[process].send(**message)
        except OSError:
            time.sleep(2 * self.patience)  # it is gone: the watch says so meanwhile, and ends this process
            raise

    def _listen(self, process: int) -> None:
        link, reason, status = self.links[process], "", 1
        while not (reason or self._parting):
            try:
                message = link.receive()
            except TimeoutError:
                reason = f"{self.name(process)} has not been heard of for {self.patience:.0f} s"
            except (OSError, ValueError) as error:
                reason = f"{self.name(process)} is gone: {error}"
            else:
                self._parting |= message.get("last", False)
                if "value" in message or "values" in message:
                    self._inbox[process].put(message.get("values", message.get("value")))
                reason, status = message.get("stop", ""), message.get("status", 1)
        if not self._parting:
            self._end(reason, status)

    def _give_signs(self) -> None:
        while not self._parting:
            for link in self.links.values():
                with contextlib.suppress(OSError):  # whoever listens to that process finds out
                    link.send()
            time.sleep(self.patience / SIGNS)

    def _end(self, reason: str, status: int) -> NoReturn:
        """Ends this process from any thread: the main one may be waiting for numbers that never come."""
        with self._ending:
            with contextlib.suppress(OSError, ValueError):  # nobody may be reading any more: it ends all the same
                sys.stderr.write(reason + (GO_ON if status == 1 else "") + "\n")
            self.stop_all(reason, status)
            leave(status)


ALONE = Team()


def meet(here: Place, told: Mapping[str, Any], patience: float) -> Team:
    """Waits until all processes are there and agree.

    Raises:
        UsageError: the coordinator cannot be reached, or processes differ in what they were told.
        RunError: a process did not come.
    """
    hello = {"process": here.process, "count": here.count, "host": socket.gethostname(), "told": _plain(told)}
    return _receive_all(here, hello, patience) if here.process == 0 else _report(here, hello, patience)


def _receive_all(here: Place, hello: Mapping[str, Any], patience: float) -> Team:
    """The first process's part: greets the others, compares, and tells all of them who is there, or why not to begin."""
    links: list[Link] = []
    hellos = {0: hello}
    try:
        with contextlib.closing(_listener(here)) as listener:
            deadline = time.monotonic() + patience
            while len(hellos) < here.count:
                link, other = _next_caller(listener, deadline, patience) or _missing(here, hellos, patience)
                links.append(link)
                agree(here, hellos, other)
                hellos[other["process"]] = other
    except (UsageError, RunError) as error:
        for link in links:
            with contextlib.suppress(OSError):  # it did not wait
                link.send(stop=str(error), status=2 if isinstance(error, UsageError) else 1)
            link.close()
        raise
    hosts = tuple(str(hellos[process]["host"]) for process in range(here.count))
    for link in links:
        link.send(hosts=hosts)
    return Team(0, hosts, dict(zip(list(hellos)[1:], links, strict=True)), patience)


def _listener(here: Place) -> socket.socket:
    """The coordinator's port, on all addresses, until JAX takes it over."""
    try:
        if socket.has_dualstack_ipv6():
            return socket.create_server(("", here.port), family=socket.AF_INET6, dualstack_ipv6=True, backlog=here.count)
        return socket.create_server(("", here.port), backlog=here.count)
    except OSError as error:
        raise UsageError(f"--coordinator {here.address}: port {here.port} cannot be opened: {error.strerror}") from error


def _next_caller(listener: socket.socket, deadline: float, patience: float) -> tuple[Link, dict[str, Any]] | None:
    """The next process that says hello; None when time is up. Who calls and says something else is not one of ours."""
    while (left := deadline - time.monotonic()) > 0:
        listener.settimeout(left)
        try:
            link = Link(listener.accept()[0], HELLO_S)
        except TimeoutError:
            break
        with contextlib.suppress(OSError, ValueError):
            hello = link.receive()
            if {"process", "count", "host", "told"} <= set(hello):
                link.connection.settimeout(patience)
                return link, hello
        link.close()
    return None


def _missing(here: Place, came: Mapping[int, Any], patience: float) -> NoReturn:
    absent = [str(process) for process in range(here.count) if process not in came]
    raise RunError(f"--process-count {here.count}: process {', '.join(absent)} did not come within {patience:.0f} s")


def agree(here: Place, hellos: Mapping[int, Mapping[str, Any]], other: Mapping[str, Any]) -> None:
    """Compares what a process says with what the first one knows.

    Raises:
        UsageError: it does not fit; names the process, what differs, and both values.
    """
    first, process = hellos[0], other["process"]
    name = f"process {process} ({other['host']})"
    if other["count"] != here.count:
        raise UsageError(f"{name} has --process-count {other['count']}, process 0 ({first['host']}) has {here.count}")
    if process in hellos:
        raise UsageError(f"--process-id {process}: both {hellos[process]['host']} and {other['host']} have it")
    for what in sorted({*first["told"], *other["told"]}):
        ours, theirs = first["told"].get(what), other["told"].get(what)
        if ours != theirs:
            raise UsageError(f"{name} has {what} {theirs}, process 0 ({first['host']}) has {ours}: all processes need the same")


def _report(here: Place, hello: Mapping[str, Any], patience: float) -> Team:
    """The part of all others: says hello to the first process and hears who else is there, or why not to begin."""
    deadline, why = time.monotonic() + patience, ""
    while (left := deadline - time.monotonic()) > 0:
        try:
            link, answer = _call(here, hello, left, patience)
        except (OSError, ValueError) as error:
            why = str(error)
        else:
            if "hosts" in answer:
                link.connection.settimeout(patience)
                return Team(here.process, tuple(answer["hosts"]), {0: link}, patience)
            link.close()
            if "stop" in answer:
                raise (UsageError if answer.get("status") == 2 else RunError)(answer["stop"])
            why = "what answers there is no process of this training"
        time.sleep(RETRY_S)
    raise UsageError(f"--coordinator {here.address}: cannot be reached within {patience:.0f} s: {why}")


def _call(here: Place, hello: Mapping[str, Any], left: float, patience: float) -> tuple[Link, dict[str, Any]]:
    """Says hello to the first process and waits for its answer, which it gives when all are there."""
    link = Link(socket.create_connection((here.host, here.port), timeout=left), patience + HELLO_S)
    try:
        link.send(**hello)
        return link, link.receive()
    except (OSError, ValueError):
        link.close()
        raise


def leave(status: int) -> NoReturn:
    """Ends the process at once, without farewells to processes that may be gone."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):  # a full disk, a closed terminal
            stream.flush()
    os._exit(status)


def _plain(told: Mapping[str, Any]) -> dict[str, Any]:
    """As it arrives after a journey as JSON."""
    return dict(json.loads(json.dumps(told, default=str)))
