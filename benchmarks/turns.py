"""The cases of a task, each in a process of its own, taking turns.

A machine's speed drifts, on shared ones by half within minutes: what is compared is called in
turn, so that each meets the same, and compared turn by turn. In a process of its own, memory is the
case's alone, thread pools of JAX, torch and numba do not meet, and the number of devices is free.
"""

from __future__ import annotations

import itertools
import multiprocessing
import signal
import time
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection
from typing import Any

import jax

from benchmarks.harness import Case, Record, Runner, Setting, absent

LEAST, MOST = 5, 15  # turns
BUDGET_S = 20.0  # of the slowest case's turns, beyond the least number
PAUSE_S = 0.02  # before a turn, in which threads of the one before stop spinning


class _Player:
    """The parent's end of a case. Once an error has become its `record`, it does nothing."""

    def __init__(self, case: Case, setting: Setting) -> None:
        self.case, self.seconds, self.record = case, 0.0, absent(case)
        if self.record:
            return
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.process = context.Process(target=_serve, args=(case, setting, other), daemon=True)
        self.process.start()
        other.close()
        self._ask(None)  # it is built, and called once

    def turn(self) -> None:
        if not self.record:
            time.sleep(PAUSE_S)
            self.seconds += self._ask(True) or 0.0

    def finish(self) -> Record:
        self.record = self.record or self._ask(False) or self.record
        assert self.record
        return self.record

    def close(self) -> None:
        if hasattr(self, "process"):
            self.process.kill()
            self.process.join()

    def _ask(self, message: bool | None) -> Any:
        """The child's answer; None where there is none, and the error is the record."""
        try:
            if message is not None:
                self.pipe.send(message)
            answer = self.pipe.recv()
        except (EOFError, OSError):
            self.process.join()
            answer = f"its process ended with code {self.process.exitcode}"
        if isinstance(answer, str):  # one broken case must not cost the others
            self.record = Record(*self.case.name, failed=True, skipped=answer)
            return None
        return answer


def _serve(case: Case, setting: Setting, pipe: Connection) -> None:
    """The child's end: answers None when ready, seconds for each turn, then the record; an error
    as text."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its children
    jax.config.update("jax_num_cpu_devices", setting.devices if case.splits else 1)
    try:
        runner = Runner(case, setting)
        pipe.send(None)
        while pipe.recv():
            pipe.send(runner.turn())
        pipe.send(runner.record())
    except Exception as e:
        pipe.send(f"{type(e).__name__}: {e}")


def by_task(cases: Sequence[Case]) -> Iterator[list[Case]]:
    """The cases of each task, which follow each other."""
    for _, group in itertools.groupby(cases, key=lambda case: case.name[:2]):
        yield list(group)


def in_turn(cases: Sequence[Case], setting: Setting) -> list[Record]:
    """The records of cases that took turns; an error becomes the record of its case."""
    players: list[_Player] = []
    try:
        for case in cases:  # one is built after the other
            players.append(_Player(case, setting))
        for turn in range(MOST):
            if turn >= LEAST and max(player.seconds for player in players) > BUDGET_S:
                break
            for player in players:
                player.turn()
        return [player.finish() for player in players]
    finally:
        for player in players:
            player.close()
