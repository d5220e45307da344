# SPDX-License-Identifier: Apache-2.0
"""2D localization and SLAM with retro-reflective markers and a 2D laser.

The names below are the Python API; each is imported when it is first used.
"""

import importlib
from typing import TYPE_CHECKING, Any

from rlml_slam.version import __version__ as __version__

__all__ = [
    'Parameters',
    'RlmlError',
    'Slam',
    'evaluate',
    'load_map',
    'read_bag',
    'read_parameters',
    'replay',
    'save_map',
]

if TYPE_CHECKING:
    from rlml_slam.api import Slam, evaluate, load_map, read_bag, read_parameters, replay, save_map
    from rlml_slam.errors import RlmlError
    from rlml_slam.params import Parameters
else:
    _HOME = {'RlmlError': 'rlml_slam.errors', 'Parameters': 'rlml_slam.params'}

    def __getattr__(name: str) -> Any:
        """A name of the API, imported at its first use (PEP 562)."""
        if name not in __all__:
            raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
        value = getattr(importlib.import_module(_HOME.get(name, 'rlml_slam.api')), name)
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        return sorted([*globals(), *__all__])
