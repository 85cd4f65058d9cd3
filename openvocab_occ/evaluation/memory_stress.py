"""Writers that fight over chunks, and writers that are killed: what is lost?"""

import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import dataclass

import numpy as np

from openvocab_occ.geometry import GridSpec
from openvocab_occ.memory import TileMap
from openvocab_occ.memory.health import verify

CLASSES = ("a", "b", "c", "free")
LINE = GridSpec((0.0, 0.0, -1.0), 0.4, (256, 4, 8))
"""Over four tiles in a row; every update touches all four."""
_SLOTS = 250  # voxels of a tile that one writer has to itself
_CHILD = "import sys; from openvocab_occ.evaluation.memory_stress import child; child(*sys.argv[1:])"


@dataclass(frozen=True)
class Stress:
    """What a test found."""

    updates: int
    """That were acknowledged."""
    lost: int
    """Of them, those that are not in the map."""
    unreadable: int
    """Tiles and journal entries that cannot be read."""
    kills: int = 0


def child(path: str, me: str, first: str, count: str) -> None:
    """Write updates; print the number of each once it is acknowledged."""
    city = TileMap.open(path)
    _say("ready")
    sys.stdin.readline()
    for n in range(int(first), int(first) + int(count)):
        mask = np.zeros(LINE.shape, dtype=np.bool_)
        mask[_places(int(me), n)] = True
        logits = np.zeros((*LINE.shape, len(CLASSES)), dtype=np.float32)
        logits[..., n % len(CLASSES)] = 4
        city.write(logits, mask, np.eye(4), LINE, stamp=1000.0 + n, agent=f"agent-{me}", log="shared")
        _say(n)


def fight(city: TileMap, *, writers: int = 3, updates: int = 25) -> Stress:
    """Let processes write `updates` each, at the same time, into the same four chunks."""
    children = [_start(city, me, 0, updates) for me in range(writers)]
    for process in children:
        _go(process)
    done = []
    for process in children:
        out, err = process.communicate()
        if process.returncode:
            raise RuntimeError(err)
        done.append([int(word) for word in out.split()])
    lost = sum(_lost(city, me, numbers) for me, numbers in enumerate(done))
    health = verify(city)
    return Stress(sum(map(len, done)), lost, sum(map(len, health.damaged.values())) + len(health.damaged_entries))


def kill(city: TileMap, *, kills: int = 3, seed: int = 0) -> Stress:
    """Kill a writer at a random moment, look at the map, start the next one."""
    dice, first, updates, lost, unreadable = random.Random(seed), 0, 0, 0, 0
    for _ in range(kills):
        process = _start(city, 0, first, 10**6)
        _go(process)
        assert process.stdout is not None
        acknowledged = process.stdout.readline()  # it has warmed up
        time.sleep(dice.uniform(0.0, 0.3))
        os.kill(process.pid, signal.SIGKILL)
        out, _ = process.communicate()
        numbers = [int(line) for line in (acknowledged + out).split("\n")[:-1]]  # the last may be cut off
        health = verify(city)
        unreadable += sum(map(len, health.damaged.values())) + len(health.damaged_entries)
        lost += _lost(city, 0, numbers[-_SLOTS + 1 :])
        updates += len(numbers)
        first += len(numbers) + 1
    return Stress(updates, lost, unreadable, kills)


def _places(me: int, n: int) -> tuple[np.ndarray, int, int]:
    at = me * _SLOTS + n % _SLOTS
    return np.arange(4) * 64 + at % 64, at // 64 % 4, at // 256


def _lost(city: TileMap, me: int, numbers: list[int]) -> int:
    """Count updates of which some voxel holds neither them nor the one that came to its place later."""
    prior = city.read(np.eye(4), LINE)
    label = prior.logits.argmax(axis=-1)
    latest = {n % _SLOTS: n for n in numbers}
    return sum(
        not (prior.known[_places(me, n)] & (label[_places(me, n)] == n % len(CLASSES))).all() for n in latest.values()
    )


def _say(word: object) -> None:
    sys.stdout.write(f"{word}\n")
    sys.stdout.flush()


def _start(city: TileMap, me: int, first: int, count: int) -> subprocess.Popen[str]:
    arguments = [sys.executable, "-c", _CHILD, city.store.name, str(me), str(first), str(count)]
    pipe = subprocess.PIPE
    process = subprocess.Popen(arguments, text=True, stdin=pipe, stdout=pipe, stderr=pipe)
    assert process.stdout is not None
    process.stdout.readline()
    return process


def _go(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()
