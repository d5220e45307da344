# SPDX-License-Identifier: Apache-2.0
"""Messages that nobody should send: one to three fields of a good one become something else."""

from __future__ import annotations

import array
import copy
from typing import Any

import numpy as np
from rclpy.serialization import deserialize_message

from rlml_slam.ros.codecs import decode

REALS = (
    float('nan'), float('inf'), -float('inf'), 0.0, -0.0, 1e308, -1e308, 5e-324, 1e9, -1e9, 1e-9,
    -1.0, 3.4e38,
)  # fmt: skip
TEXTS = ('', '/', 'map', 'base_link', 'laser', 'a' * 300, 'ünknown frame', '\x01', '../../etc')
BESIDE = -5_000_000, 5_000_000  # [ns] of a mutated message from the good one
MOST = 100_000  # elements of a sequence that grows


def mutated(msg: Any, rng: np.random.Generator) -> Any:
    """A copy with one to three fields changed: numbers, lengths, texts, stamps, frames."""
    out = copy.deepcopy(msg)
    for _ in range(rng.integers(1, 4)):
        _change(out, rng)
    return out


def beside(data: bytes, kind: type, topic: str, rng: np.random.Generator) -> Any:
    """A mutated message made of a good one, at a stamp of its own: else it is a duplicate."""
    msg = deserialize_message(data, kind)
    stamp = decode.stamp(msg, topic) + int(rng.integers(*BESIDE))
    msg.header.stamp.sec, msg.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
    return mutated(msg, rng)


def _change(msg: Any, rng: np.random.Generator) -> None:
    fields = msg.get_fields_and_field_types()
    name = str(rng.choice(list(fields)))
    kind, value = fields[name], getattr(msg, name)
    if hasattr(value, 'get_fields_and_field_types'):
        _change(value, rng)
    elif isinstance(value, str):
        setattr(msg, name, str(rng.choice(TEXTS)))
    elif isinstance(value, bool):
        setattr(msg, name, not value)
    elif isinstance(value, int):
        setattr(msg, name, _whole(kind, rng))
    elif isinstance(value, float):
        setattr(msg, name, _real(kind, rng))
    elif isinstance(value, np.ndarray):  # of a fixed length
        changed = value.copy()
        changed[rng.integers(len(changed))] = _real('double', rng)
        setattr(msg, name, changed)
    elif isinstance(value, array.array):
        setattr(msg, name, _sequence(value, kind, rng))
    elif isinstance(value, list) and value:
        _change_list(value, rng)


def _whole(kind: str, rng: np.random.Generator) -> int:
    unsigned, bits = kind.startswith(('u', 'octet')), int(''.join(filter(str.isdigit, kind)) or 8)
    low = 0 if unsigned else -(2 ** (bits - 1))
    high = 2**bits - 1 if unsigned else 2 ** (bits - 1) - 1
    any_one = int(
        rng.integers(low, high, endpoint=True, dtype=np.uint64 if unsigned else np.int64)
    )
    return int(rng.choice(np.array([low, high, 0, 1, 3, any_one], dtype=object)))


def _real(kind: str, rng: np.random.Generator) -> float:
    value = float(rng.choice(REALS)) if rng.random() < 0.8 else float(rng.normal(0.0, 100.0))
    largest = 3.4e38
    return max(-largest, min(largest, value)) if kind == 'float' and np.isfinite(value) else value


def _sequence(value: array.array[Any], kind: str, rng: np.random.Generator) -> array.array[Any]:
    choice, n = rng.integers(5), len(value)
    if choice == 0:
        return array.array(value.typecode)
    if choice == 1:
        return value[: int(rng.integers(0, n + 1))]
    if choice == 2 and n:
        return array.array(value.typecode, (value * (MOST // n + 1))[: int(rng.integers(n, MOST))])
    out = array.array(value.typecode, value)
    for k in rng.integers(0, max(n, 1), min(n, 20)).tolist():
        if value.typecode in 'fd':
            out[k] = _real('float', rng)
        else:
            bits = 8 * value.itemsize
            signed = value.typecode.islower()
            out[k] = int(rng.integers(0, 2 ** (bits - 1))) - (2 ** (bits - 1) if signed else 0)
    return out


def _change_list(value: list[Any], rng: np.random.Generator) -> None:
    k = int(rng.integers(len(value)))
    choice = rng.integers(4)
    if choice == 0:
        del value[k]
    elif choice == 1:
        value.extend(value[:1] * int(rng.integers(1, 1000)))
    elif hasattr(value[k], 'get_fields_and_field_types'):
        _change(value[k], rng)
    elif isinstance(value[k], float):
        value[k] = _real('double', rng)


def random_bytes(rng: np.random.Generator) -> bytes:
    """Bytes that are no message, half of them with the head of one."""
    head = b'\x00\x01\x00\x00' if rng.random() < 0.5 else b''
    return head + rng.bytes(int(rng.integers(0, 400)))


def damaged_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    """A serialized message that was cut off, or some of whose bytes are others."""
    out = bytearray(data)
    for k in rng.integers(0, len(out), 4).tolist():
        out[k] = int(rng.integers(256))
    return bytes(out[: int(rng.integers(len(out)))] if rng.random() < 0.3 else out)
