# SPDX-License-Identifier: Apache-2.0
"""Compile the kernels of the main job (``--all``: of every system), with the time of each."""

from __future__ import annotations

import sys
import time

from rlml_slam import warm_up


def main() -> None:
    """Compile what is not yet cached."""
    warm_up.import_core('--all' in sys.argv)
    began = time.perf_counter()
    modules = warm_up.loaded()
    for k, (name, compile_module) in enumerate(modules, 1):
        start = time.perf_counter()
        compile_module()
        seconds = time.perf_counter() - start
        print(
            f'  {k}/{len(modules)} {name.removeprefix("rlml_slam.")}: {seconds:.1f} s', flush=True
        )
    print(f'  {time.perf_counter() - began:.1f} s in all')


if __name__ == '__main__':
    main()
