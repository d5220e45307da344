# SPDX-License-Identifier: Apache-2.0
"""Bytes of files that nobody should write: bits, numbers, words, lines, lengths of a good one."""

from __future__ import annotations

from typing import Any

import numpy as np

from rlml_slam.maps.map_container import Content

WORDS = (
    b'nan', b'inf', b'-inf', b'1e308', b'-1e308', b'1e-320', b'0', b'-1', b'99999999999999999999',
    b'9' * 5000, b'', b'\0', b'\xff\xfe', b'../../etc/passwd', b'/dev/zero', b'[' * 2000, b'{}',
    b'&a [*a, *a]', b'*a', b'null', b'2001-99-99', b'<<: *a', b'"', b'\n', b'-', b'e', b',',
)  # fmt: skip
NUMBERS = tuple(
    value.to_bytes(size, 'little', signed=value < 0)
    for size in (4, 8) for value in (0, 1, -1, 2 ** (8 * size - 1) - 1, 1 << 20, 1 << 30)
)  # fmt: skip
SEPARATORS = b' ,:\n\t[]{}'


def mutated_bytes(data: bytes, rng: np.random.Generator, is_text: bool) -> bytes:
    """One to three changes of the bytes of a file."""
    out = data
    for _ in range(int(rng.integers(1, 4))):
        out = _change(out, rng, is_text)
    return out


def _change(data: bytes, rng: np.random.Generator, is_text: bool) -> bytes:
    n = len(data)
    if not n:
        return data
    a, b = sorted(int(k) for k in rng.integers(0, n + 1, 2))
    way = int(rng.integers(6))
    if way == 0:  # cut off
        return data[:a]
    if way == 1:  # a part is missing, or there twice
        b = min(b, a + 1000)
        return data[:a] + data[b:] if rng.random() < 0.5 else data[:b] + data[a:b] + data[b:]
    if way == 2:
        flipped = bytearray(data)
        flipped[min(a, n - 1)] ^= 1 << int(rng.integers(8))
        return bytes(flipped)
    if is_text:
        begin = max(data.rfind(bytes([c]), 0, a) for c in SEPARATORS) + 1
        ends = [k for c in SEPARATORS if (k := data.find(bytes([c]), a)) >= 0]
        end = max(min(ends, default=n), begin)
        return data[:begin] + WORDS[int(rng.integers(len(WORDS)))] + data[end:]
    number = NUMBERS[int(rng.integers(len(NUMBERS)))]
    return data[:a] + number + data[a + len(number) :]


def mutated_content(content: Content, rng: np.random.Generator) -> Content:
    """Arrays and description of a container with one to three changes; its checksum will fit."""
    arrays, description = dict(content.arrays), dict(content.description)
    for _ in range(int(rng.integers(1, 4))):
        if not arrays or rng.random() < 0.1:
            name = str(rng.choice(list(description)))
            description[name] = _other_value(rng)
            continue
        name = str(rng.choice(list(arrays)))
        arrays[name] = _other_array(arrays[name], rng)
    return Content(arrays, description)


def _other_value(rng: np.random.Generator) -> Any:
    values: tuple[Any, ...] = (None, '', -1, 1e308, [], {}, {'back_end': 3}, 'nonsense', [[]])
    return values[int(rng.integers(len(values)))]


def _other_array(array: np.ndarray[Any, Any], rng: np.random.Generator) -> np.ndarray[Any, Any]:
    way, n = int(rng.integers(6)), len(array) if array.ndim else 0
    if way == 0:
        return array[: int(rng.integers(0, n + 1))] if array.ndim else array.reshape(1)
    if way == 1:
        return np.concatenate([array, array[:1]]) if n else np.zeros(3)
    if way == 2:
        return array.reshape(-1)
    if way == 3:
        return array.astype(np.float32) if array.dtype.names is None else array[:0]
    changed = array.copy().reshape(-1)
    if not changed.size:
        return changed
    k = int(rng.integers(changed.size))
    raw = changed[k : k + 1].view(np.uint8)
    if rng.random() < 0.5 and changed.dtype.kind == 'f':
        changed[k] = rng.choice([np.nan, np.inf, -1.0, 1e30, 0.0])
    elif rng.random() < 0.5 and changed.dtype.kind in 'iu':
        info = np.iinfo(changed.dtype)
        changed[k] = rng.choice(np.array([info.min, info.max, 0, 1], dtype=changed.dtype))
    else:
        raw[int(rng.integers(raw.size))] = int(rng.integers(256))
    return changed.reshape(array.shape)
